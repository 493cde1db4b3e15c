"""Files of meshes against their construction: boxes with given places, areas and numbers of faces."""

import json
import struct

import jax
import numpy as np
import pytest
import trimesh

import jaxnbv as nbv

BOX = trimesh.creation.box((1.0, 2.0, 3.0))
AREA = 2 * (2.0 + 3.0 + 6.0)
# Polygons of the box by their corners, and two unused places.
CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
MIXED = [*QUADS[:5], [1, 5, 7], [1, 7, 3], [0, 1]]
UNUSED = np.array([[50.0, 0.0, 0.0], [0.0, -60.0, 0.0]])


def glb(path, tree, *arrays):
    """A GLB file of these arrays, one accessor each. `tree` has the rest."""
    kinds = {"f4": 5126, "i2": 5122, "u2": 5123, "u1": 5121, "i1": 5120}
    views, accessors, binary = [], [], b""
    for array in arrays:
        flat = array.ndim == 1
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes})
        accessor = {"bufferView": len(accessors), "componentType": kinds[array.dtype.str[1:]], "count": len(array)}
        ends = {} if flat else {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        accessors.append(accessor | {"type": "SCALAR" if flat else "VEC3"} | ends)
        binary += array.tobytes() + b"\0" * (-array.nbytes % 4)
    tree = {"asset": {"version": "2.0"}, "scene": 0, "buffers": [{"byteLength": len(binary)}]} | tree
    tree["accessors"] = [a | b for a, b in zip(accessors, tree.get("accessors", [{}] * len(accessors)), strict=True)]
    tree["bufferViews"] = views
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def boxes(**changes):
    """Two boxes three apart that share their triangles. The first is on a node of its own."""
    tree = {
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "name": "near"}, {"mesh": 0, "name": "far", "translation": [3.0, 0.0, 0.0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }
    return tree | changes


PLACES, ROWS = BOX.vertices.astype("<f4"), BOX.faces.astype("<u2").ravel()


def world(mesh):
    """The area, and the lowest and highest corner in the file's coordinates."""
    vertices = mesh.frame.to_world(mesh.vertices)
    return trimesh.Trimesh(vertices, mesh.faces, process=False).area, vertices.min(axis=0), vertices.max(axis=0)


def check_boxes(mesh, count=2):
    area, low, high = world(mesh)
    assert area == pytest.approx(count * AREA, rel=1e-3)
    np.testing.assert_allclose(low, [-0.5, -1.0, -1.5], atol=1e-3)
    np.testing.assert_allclose(high, [0.5 + 3.0 * (count - 1), 1.0, 1.5], atol=1e-3)


def test_a_plain_file_of_two_boxes(tmp_path):
    check_boxes(nbv.load_mesh(glb(tmp_path / "boxes.glb", boxes(), PLACES, ROWS)))


@pytest.mark.parametrize(("kind", "largest"), [("<i2", 32767), ("i1", 127)])
def test_normalised_integers_are_shares_of_their_largest(tmp_path, kind, largest):
    """Quantised files have such integers, and nodes that scale them back, here by 2."""
    stored = np.round(PLACES / 2.0 * largest).astype(kind)
    if kind == "i1":
        stored = np.concatenate([stored, np.zeros((1, 3), kind)])
    nodes = [{"mesh": 0, "scale": [2.0] * 3, "translation": [place, 0.0, 0.0]} for place in (0.0, 3.0)]
    tree = boxes(nodes=nodes, accessors=[{"normalized": True}, {}], extensionsRequired=["KHR_mesh_quantization"])
    area, low, high = world(nbv.load_mesh(glb(tmp_path / "boxes.glb", tree, stored, ROWS)))
    assert area == pytest.approx(2 * AREA, rel=0.02)
    np.testing.assert_allclose([low, high], [[-0.5, -1.0, -1.5], [3.5, 1.0, 1.5]], atol=1.01 / largest)


def primitive(**changes):
    return [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1} | changes]}]


SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}
DRACO = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
UNREAD = {
    "sparse places": (boxes(accessors=[{"sparse": SPARSE}, {}]), "sparse accessors"),
    "sparse corners": (boxes(accessors=[{}, {"sparse": SPARSE}]), "sparse accessors"),
    "one part in Draco": (
        boxes(meshes=primitive() + primitive(extensions=DRACO), extensionsRequired=list(DRACO)),
        "Draco compression",
    ),
    "meshopt": (boxes(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression"),
    "a skeleton": (
        boxes(nodes=[{"mesh": 0, "skin": 0, "translation": [9.0, 0.0, 0.0]}, {}], skins=[{"joints": [1]}]),
        "apply the armature",
    ),
    "shape keys": (boxes(meshes=[primitive()[0] | {"weights": [0.0, 0.5]}]), "shape keys"),
    "fans": (
        boxes(meshes=[{"primitives": primitive()[0]["primitives"] * 2 + primitive(mode=6)[0]["primitives"]}]),
        "fans",
    ),
    "copies by an extension": (
        boxes(nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {}}}}, {}]),
        "EXT_mesh_gpu_instancing",
    ),
    "a box below a camera": (
        boxes(nodes=[{"camera": 0, "translation": [0.0, 0.0, 7.0], "children": [1]}, {"mesh": 0}]),
        "below a camera",
    ),
    "places that are not the declared ones": (boxes(accessors=[{"max": [0.5, 1.0, 2.0]}, {}]), "declares that mesh 0"),
}


@pytest.mark.parametrize("name", UNREAD)
def test_data_that_trimesh_ignores_is_named(tmp_path, name):
    tree, message = UNREAD[name]
    with pytest.raises(nbv.InputError, match=message):
        nbv.load_mesh(glb(tmp_path / "boxes.glb", tree, PLACES, ROWS))


def obj(polygons=QUADS, corner="{}", points=CORNERS):
    lines = [f"v {x} {y} {z}" for x, y, z in [*points, *UNUSED]]
    faces = ["f " + " ".join(corner.format(row + 1) for row in polygon) for polygon in polygons]
    return "\n".join([*lines, *faces, ""])


def off(polygons=MIXED):
    lines = ["OFF # a box", f"{len(CORNERS) + 2} {len(polygons)} 0", ""]
    lines += [f"{x} {y} {z}" for x, y, z in [*CORNERS, *UNUSED]] + ["# faces, with colours"]
    return "\n".join([*lines, *(f"{len(p)} {' '.join(map(str, p))} 0.1 0.2 0.3" for p in polygons), "", ""])


def ply(encoding="ascii", polygons=MIXED, order="<", element="face", textured=False):
    points = np.concatenate([CORNERS, UNUSED])
    lines = ["ply", f"format {encoding} 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"] + [f"element {element} {len(polygons)}"]
    lines += ["property list uchar int vertex_indices"] + ["property list uchar float texcoord"] * textured
    head = "\n".join([*lines, "end_header", ""])
    if encoding == "ascii":
        faces = [[len(polygon), *polygon, *[2 * len(polygon)] * textured] for polygon in polygons]
        faces = [row + [0.5] * (row[-1] * textured) for row in faces]
        return head + "\n".join(" ".join(map(str, row)) for row in [*points.tolist(), *faces]) + "\n"
    body = points.astype(f"{order}f4").tobytes()
    body += b"".join(struct.pack(f"{order}B{len(p)}i", len(p), *p) for p in polygons)
    return head.encode() + body


RELATIVE = (
    "".join("".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS[quad]) + "f -4 -3 -2 -1\n" for quad in QUADS)
    + "v 50 0 0\n"
)
STRIP = [[0, 1, 2, 3, 6, 7, 4, 5, 0, 1, -1, 0, 2, 4, 6, -1, 1, 5, 3, 7, -1]]
WHOLE = {
    "plain.obj": obj(),
    "mark.obj": b"\xef\xbb\xbf" + obj().encode(),
    "utf16.obj": obj().encode("utf-16"),
    "utf32.obj": obj().encode("utf-32"),
    "tabs.obj": obj().replace("v ", "v\t").replace("f ", "\tf\t"),
    "old_mac.obj": obj().replace("\n", "\r"),
    "windows.obj": obj().replace("\n", "\r\n"),
    "continued.obj": obj().replace(" 2\n", " \\\n2\n"),
    "relative.obj": RELATIVE,
    "mixed.obj": obj(MIXED),
    "mixed_references.obj": obj(QUADS[:3], "{}/1") + obj(QUADS[3:], "{}//2").partition("f ")[2].join(["f ", ""]),
    "colours.obj": obj().replace("\nf", " 0.1 0.2 0.3\nf", 1),
    "comments.obj": obj().replace("\n", " # the end\n"),
    "plain.off": off(),
    "mark.off": b"\xef\xbb\xbf" + off().encode(),
    "normals.off": off().replace("OFF", "CNOFF", 1),
    "plain.ply": ply(),
    "mark.ply": b"\xef\xbb\xbf" + ply().encode(),
    "blank.ply": ply().replace("\n8 ", "\n\n8 ").replace("end_header\n", "end_header\n\n"),
    "windows.ply": ply().replace("\n", "\r\n"),
    "quads.ply": ply("binary_little_endian", QUADS),
    "mixed.ply": ply("binary_little_endian"),
    "mixed_big.ply": ply("binary_big_endian", order=">"),
    "textured.ply": ply(textured=True),
    "strips.ply": ply(polygons=STRIP, element="tristrips"),
    "strips_binary.ply": ply("binary_little_endian", STRIP, element="tristrips"),
}


@pytest.mark.parametrize("name", WHOLE)
def test_complete_files_are_read(tmp_path, name):
    """A box of 1 x 2 x 3. Unused places and faces with two corners are allowed."""
    content = WHOLE[name]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = nbv.load_mesh(tmp_path / name)
    area, low, high = world(mesh)
    assert len(mesh.faces) == 12
    assert area == pytest.approx(AREA)
    np.testing.assert_allclose([low, high], [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], atol=1e-6)
    # The winding of strips alternates. Polygons that share an edge run along it in opposite directions.
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    assert whole.is_watertight
    assert "strips" in name or whole.is_winding_consistent


CUT = {
    "commas.obj": (obj().replace(".", ","), "decimal points in place of commas"),
    "commas.off": (off().replace(".", ","), "decimal points in place of commas"),
    "commas.ply": (ply().replace(".0 ", ",0 "), "decimal points in place of commas"),
    "points.ply": (ply(polygons=[]), "no faces"),
    "early.ply": (ply()[:-30], r"has \d of the 8 'face' elements"),
    "early_binary.ply": (ply("binary_little_endian")[:-9], "has 7 of the 8 'face' elements"),
    "early_quads.ply": (ply("binary_little_endian", QUADS)[:-9], "has 5 of the 6 'face' elements"),
    "early_points.ply": (ply("binary_little_endian")[:-160], r"has \d of the 10 'vertex' elements"),
    "early.off": (off()[:-60], r"of the 8 faces that its header declares"),
    "binary.off": ("OFF BINARY\n" + off()[4:], "save it as PLY"),
    "four.off": ("4" + off(), "save it as PLY"),
    "word.obj": (obj().replace("f 1", "f one"), "'f one 2 4 3'"),
    "far.obj": (obj([[0, 1, 30]]), "faces refer to vertices 0 to 30"),
}


@pytest.mark.parametrize("name", CUT)
def test_what_cannot_be_read_is_named(tmp_path, name):
    content, message = CUT[name]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(nbv.InputError, match=message) as caught:
        nbv.load_mesh(tmp_path / name)
    assert name in str(caught.value)


def test_meshes_and_scenes_of_trimesh(tmp_path):
    scene = trimesh.Scene([BOX, BOX.copy().apply_translation((3.0, 0.0, 0.0))])
    check_boxes(nbv.load_mesh(BOX), 1)
    check_boxes(nbv.load_mesh(scene))
    assert nbv.load_mesh(BOX, up="z").frame.up == "z"
    assert len(nbv.scanning.load_parts(scene).parts) == 2
    with pytest.raises(nbv.InputError, match="no faces"):
        nbv.load_mesh(trimesh.Trimesh(CORNERS))
    with pytest.raises(nbv.InputError, match="give str or Path or Trimesh or Scene"):
        nbv.load_mesh(trimesh.PointCloud(CORNERS))


def test_functions_of_meshes_take_those_of_trimesh():
    bank = nbv.ShapeBank.from_meshes([BOX, trimesh.creation.icosphere(2)], resolution=16, progress=False)
    places = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 0.0, 1.1]])
    solids = [jax.tree.map(lambda rows, row=row: rows[row], bank.solids) for row in range(2)]
    inside = [np.asarray(solid(places)) < 0 for solid in solids]
    # The box is 0.83 x 1.67 x 2.5. The ball's radius is 1.25.
    np.testing.assert_array_equal(inside, [[True, False, True], [True, True, True]])
    assert bank.names == ("0", "1")
    ray = np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 0.0, -1.0]])
    np.testing.assert_allclose(nbv.scanning.as_surface(BOX).trace(*ray).points, [[0.0, 0.0, 1.25]], atol=1e-6)
