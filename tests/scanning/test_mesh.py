"""Rays of meshes against closed forms and a slow Moller-Trumbore in NumPy; broken meshes."""

import copy
import pickle
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from bumps import random_rays
from on_grid import nodes

import jaxnbv as nbv
from jaxnbv.scanning.mesh_files import load_parts
from jaxnbv.scanning.sdf import Cuboid, Sphere, Torus
from jaxnbv.storage.folders import software

RNG = np.random.default_rng(1)


def moller_trumbore(vertices, faces, o, d):
    """Least positive ray parameter over all triangles, in float64. Infinite for a miss."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(d[:, None], e2)
    det = np.sum(p * e1, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = o[:, None] - a
        u = np.sum(s * p, axis=-1) / det
        q = np.cross(s, e1)
        v = np.sum(d[:, None] * q, axis=-1) / det
        t = np.sum(e2 * q, axis=-1) / det
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0), t, np.inf).min(axis=1)


SHAPES = {
    "icosphere": trimesh.creation.icosphere(2, 3.0),
    "box": trimesh.creation.box((2.0, 5.0, 3.0)),
    "torus": trimesh.creation.torus(2.0, 0.7, 40, 20),
}


@pytest.fixture(params=["embreex", "libigl"])
def tracer(request, monkeypatch):
    if request.param == "libigl":
        monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    elif "embreex" not in software():
        pytest.skip("Embree has no wheel for this machine")
    assert request.param in software()


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.usefixtures("tracer")
def test_hits_equal_moller_trumbore(name):
    mesh = nbv.TriangleMesh.from_arrays(SHAPES[name].vertices + 7.0, SHAPES[name].faces)
    o, d = random_rays(RNG, 500, spread=0.8, dtype=float)
    hits = mesh.trace(o, d)
    t = moller_trumbore(mesh.vertices, mesh.faces, o, d)
    mask = np.asarray(hits.mask)
    assert (mask != np.isfinite(t)).sum() <= 1
    use = mask & np.isfinite(t)
    assert use.sum() > 150
    np.testing.assert_allclose(np.asarray(hits.points)[use], (o + t[:, None] * d)[use], atol=2e-5)
    assert (np.sum(np.asarray(hits.normals)[use] * d[use], axis=1) < 0).all()
    assert not np.asarray(hits.points)[~mask].any()
    # Rays that start beyond the mesh or look away meet nothing.
    assert not np.asarray(mesh.trace(o, -d).mask).any()
    assert not np.asarray(mesh.trace(o + 100 * d, d).mask).any()


@pytest.mark.usefixtures("tracer")
def test_few_rays_slip_through_edges_of_small_triangles():
    """Rays from the middle of a ball of 327,680 faces to its corners and the middles of its edges. Embree loses a
    fifth of a percent."""
    ball = trimesh.creation.icosphere(7, 1.25)
    mesh = nbv.TriangleMesh(ball.vertices, ball.faces, nbv.Frame())
    targets = np.concatenate([mesh.vertices, mesh.vertices[ball.edges_unique].mean(axis=1)])[::7]
    hits = mesh.trace(np.zeros_like(targets), targets / np.linalg.norm(targets, axis=1, keepdims=True))
    mask = np.asarray(hits.mask)
    assert mask.mean() > 0.997
    np.testing.assert_allclose(np.asarray(hits.points)[mask], targets[mask], atol=1e-5)


def test_a_mesh_that_was_scanned_is_copied():
    mesh = nbv.TriangleMesh.from_arrays(SHAPES["torus"].vertices, SHAPES["torus"].faces)
    o, d = random_rays(RNG, 300, spread=0.8, dtype=float)
    hits = mesh.trace(o, d)
    for twin in (pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh), copy.copy(mesh)):
        assert eqx.tree_equal(twin, mesh)
        assert eqx.tree_equal(twin.trace(o, d), hits)


@pytest.mark.usefixtures("tracer")
def test_normals_face_the_sensor_for_any_winding_and_open_sheets():
    sphere = SHAPES["icosphere"]
    flip = RNG.random(len(sphere.faces)) < 0.5
    faces = np.where(flip[:, None], sphere.faces[:, ::-1], sphere.faces)
    straight = nbv.TriangleMesh.from_arrays(sphere.vertices, sphere.faces)
    o, d = random_rays(RNG, 500, spread=0.8, dtype=float)
    expected, hits = straight.trace(o, d), nbv.TriangleMesh.from_arrays(sphere.vertices, faces).trace(o, d)
    np.testing.assert_allclose(hits.points, expected.points, atol=1e-6)
    np.testing.assert_allclose(hits.normals, expected.normals, atol=1e-6)
    # The planes of the faces are at least 1.2 away from the middle of the ball of 1.25.
    assert (np.sum(np.asarray(expected.normals * expected.points), axis=1)[np.asarray(expected.mask)] > 1.2).all()
    sheet = nbv.TriangleMesh.from_arrays([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [2, 0, 3]])
    for side in (1.0, -1.0):
        hits = sheet.trace(np.array([[0.1, 0.2, side]]), np.array([[0.0, 0.0, -side]]))
        np.testing.assert_allclose(hits.points, [[0.1, 0.2, 0.0]], atol=1e-6)
        np.testing.assert_allclose(hits.normals, [[0.0, 0.0, side]], atol=1e-6)
    inside = straight.trace(np.zeros((1, 3)), np.array([[0.0, 0.6, 0.8]]))
    assert float(jnp.sum(inside.normals * jnp.asarray([0.0, 0.6, 0.8]))) < -0.9


def test_frame_and_unused_vertices():
    vertices = np.array([[0, 0, 0], [10, 0, 0], [0, 4, 0], [0, 0, 2], [999, 999, 999]], dtype=float)
    mesh = nbv.TriangleMesh.from_arrays(vertices, [[0, 1, 2], [0, 2, 3], [0, 1, 3]])
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(2.5)
    np.testing.assert_allclose(mesh.frame.to_world(mesh.vertices), vertices[:4], atol=1e-9)


def test_tracing_under_jit_names_the_remedy():
    mesh = nbv.TriangleMesh.from_arrays(SHAPES["box"].vertices, SHAPES["box"].faces)
    o, d = (jnp.asarray(a, dtype=jnp.result_type(float)) for a in random_rays(RNG, 3))
    for call in (lambda: jax.jit(lambda o, d: mesh.trace(o, d))(o, d), lambda: jax.jit(lambda m: m.trace(o, d))(mesh)):
        with pytest.raises(ValueError, match="solid_of_mesh"):
            call()


TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]


def test_zero_area_faces_are_dropped_and_counted():
    with pytest.warns(UserWarning, match="dropped 2 of 3 faces"):
        mesh = nbv.TriangleMesh.from_arrays(TRIANGLE, [[0, 1, 2], [0, 0, 1], [2, 2, 2]])
    assert len(mesh.faces) == 1


def test_broken_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no mesh file"):
        nbv.load_mesh(tmp_path / "absent.obj")
    for name, content in (("garbage.ply", b"\x00\x01garbage"), ("garbage.glb", b"nonsense"), ("mesh.xyzw", b"1")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match="cannot read"):
            nbv.load_mesh(tmp_path / name)
    for name, content in (("empty.obj", ""), ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n")):
        (tmp_path / name).write_text(content)
        with pytest.raises(ValueError, match=r"no faces|cannot read"):
            nbv.load_mesh(tmp_path / name)
    whole = SHAPES["box"].export(file_type="stl")
    for length in (90, 400, len(whole) - 1):
        (tmp_path / "cut.stl").write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"has no faces: .* an STL that was cut short|cannot read"):
            nbv.load_mesh(tmp_path / "cut.stl")
    (tmp_path / "nan.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n")
    with pytest.raises(ValueError, match=r"nan\.obj.*not finite"):
        nbv.load_mesh(tmp_path / "nan.obj")


def test_samples_lie_on_the_surface_and_are_even_by_area():
    mesh = nbv.TriangleMesh.from_arrays(SHAPES["box"].vertices, SHAPES["box"].faces)
    points = mesh.sample_points(jax.random.key(0), 20_000)
    half = np.array([0.5, 1.25, 0.75])
    on = np.isclose(np.abs(points), half, atol=1e-6)
    assert on.any(axis=1).all()
    area = 8 * np.prod(half) / half
    share = area / area.sum()
    # Five standard errors of a proportion of 20,000 samples.
    assert (np.abs(on.mean(axis=0) - share) < 5 * np.sqrt(share * (1 - share) / 20_000)).all()
    np.testing.assert_array_equal(points, mesh.sample_points(jax.random.key(0), 20_000))
    assert (points != mesh.sample_points(jax.random.key(1), 20_000)).any()


def test_mesh_of_a_solid():
    mesh = nbv.mesh_from_sdf(Torus(0.8, 0.3), nbv.Grid(80))
    assert mesh.to_trimesh().is_watertight
    # Marching cubes inscribes: the volume is too small by order spacing^2 / radius^2. Outward faces make it positive.
    assert mesh.to_trimesh().volume == pytest.approx(2 * np.pi**2 * 0.8 * 0.3**2, rel=0.02)
    ring = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2]) - 0.8
    np.testing.assert_allclose(np.hypot(ring, mesh.vertices[:, 1]), 0.3, atol=3e-3)
    assert mesh.frame.scale == 1.0
    with pytest.raises(ValueError, match="no surface lies within"):
        nbv.mesh_from_sdf(Sphere(5.0) | Cuboid([4.0, 4.0, 4.0]), nbv.Grid(8))


def test_an_off_file_whose_first_two_lines_run_together_is_read(tmp_path):
    """ModelNet has many such files."""
    text = trimesh.creation.box((1.0, 2.0, 4.0)).export(file_type="off")
    assert text.startswith("OFF\n8 12 0")
    for name, written in (("well", text), ("glued", "OFF" + text[4:])):
        (tmp_path / f"{name}.off").write_text(written)
    well, glued = (nbv.load_mesh(tmp_path / f"{name}.off") for name in ("well", "glued"))
    np.testing.assert_array_equal(glued.vertices, well.vertices)
    np.testing.assert_array_equal(glued.faces, well.faces)
    np.testing.assert_allclose(np.ptp(glued.vertices, axis=0), [0.625, 1.25, 2.5], rtol=1e-6)


TURN = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, -0.5))


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (4.0, 2.0, 0.3), (4.0, 2.0, 1e-4)])
def test_the_reach_of_a_turned_box_is_half_of_its_diagonal(sides):
    shape = trimesh.creation.box(sides, transform=TURN)
    mesh = nbv.TriangleMesh.from_arrays(shape.vertices, shape.faces)
    assert mesh.bounding_radius == pytest.approx(0.5 * np.linalg.norm(sides) * mesh.frame.scale)


@pytest.mark.parametrize("outward", [True, False])
def test_a_ball_contains_what_is_nearer_than_its_radius_however_it_is_wound(outward):
    shape = trimesh.creation.icosphere(4)
    mesh = nbv.TriangleMesh.from_arrays(shape.vertices, shape.faces[:, :: 1 if outward else -1])
    points = RNG.uniform(-1.7, 1.7, (400, 3))
    distance = np.linalg.norm(points, axis=1)
    clear = np.abs(distance - 1.25) > 0.02
    np.testing.assert_array_equal(mesh.contains(points)[clear], distance[clear] < 1.25)


# A slab on a post. The whole is 4 wide and 3 high.
BOXES = {"post": ((0.0, 1.0, 0.0), (1.0, 2.0, 1.0)), "slab": ((0.5, 2.5, 0.0), (4.0, 1.0, 2.0))}


def saved(path, boxes=BOXES):
    scene = trimesh.Scene()
    for name, (center, extents) in boxes.items():
        placed = trimesh.transformations.translation_matrix(center)
        scene.add_geometry(trimesh.creation.box(extents), node_name=name, transform=placed)
    scene.export(path)
    return path


def box_distance(x, center, extents):
    """Distance from points to the surface of a box."""
    beyond = np.abs(x - center) - 0.5 * np.asarray(extents)
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.where((beyond <= 0).all(axis=-1), -beyond.max(axis=-1), outside)


def test_parts_are_the_nodes_where_the_whole_has_them_with_their_distances(tmp_path):
    parts = load_parts(saved(tmp_path / "table.glb"))
    whole = nbv.load_mesh(tmp_path / "table.glb")
    assert parts.names == ("post", "slab")
    joined = np.concatenate([part.vertices for part in parts.parts])
    np.testing.assert_allclose(np.sort(joined, axis=0), np.sort(parts.mesh.vertices, axis=0), atol=1e-6)
    np.testing.assert_array_equal(parts.mesh.vertices, whole.vertices)
    # The longest side is 4, and now 2.5. The box around both is centred at (0.5, 1.5, 0).
    grid = nbv.Grid(9, 1.4)
    for part, distance, (center, extents) in zip(parts.parts, parts.distances(grid), BOXES.values(), strict=True):
        center = (np.array(center) - [0.5, 1.5, 0.0]) * 0.625
        np.testing.assert_allclose(part.vertices.mean(axis=0), center, atol=1e-6)
        np.testing.assert_allclose(
            distance, box_distance(nodes(grid.axis), center, np.array(extents) * 0.625), atol=1e-5
        )


def test_the_distance_of_a_flat_part_is_continuous_and_a_lower_bound_beyond_its_grid():
    """A cubic grid is far from the large faces of a flat part. Near its sides the distance is still exact."""
    extents = np.array([1.4, 0.4, 1.2])
    box = trimesh.creation.box(extents)
    solid = nbv.sdf.solid_of_mesh(box.vertices, box.faces, 48, cubic=True)
    side = 0.7 + float(solid.padding)
    rng = np.random.default_rng(0)
    x = rng.uniform(-2.0, 2.0, (4000, 3))
    on_side = rng.uniform(-side, side, (1500, 3))
    on_side[np.arange(1500), np.arange(1500) % 3] = side * rng.choice([-1.0, 1.0], 1500)
    cell = float(solid.spacing)
    assert (np.asarray(solid(x)) <= box_distance(x, 0.0, extents) + 0.5 * cell).all()
    np.testing.assert_allclose(solid(1.001 * on_side), solid(0.999 * on_side), atol=0.1 * cell)
    np.testing.assert_allclose(solid(1.001 * on_side), box_distance(on_side, 0.0, extents), atol=0.5 * cell)
    assert (np.asarray(solid(x)) > 0)[(np.abs(x) > 0.5 * extents + cell).any(axis=1)].all()


def test_a_file_of_one_node_has_no_parts(tmp_path):
    path = saved(tmp_path / "slab.glb", {"slab": BOXES["slab"]})
    with pytest.raises(ValueError, match=r"slab\.glb has one node"):
        load_parts(path)
