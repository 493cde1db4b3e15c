"""Reader of glTF files, which uses trimesh but rejects features that trimesh ignores or reads wrongly."""

import importlib.util
import json
import re
import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float
from trimesh.resolvers import Resolver

from jaxnbv.checks import require

# Divisor of normalised integers, keyed by the component type of their accessor.
_DIVISORS = {5120: 127.0, 5121: 255.0, 5122: 32767.0, 5123: 65535.0}
# Modes of glTF primitives: modes that trimesh reads, modes with triangles (lists and strips), and the mode of fans.
_READABLE, _TRIANGLES, _FANS = (0, 1, 4, 5), (4, 5), 6
# These required extensions are allowed, since trimesh reads them or they do not change the shape.
_HARMLESS = re.compile("material|texture|light|mesh_quantization|xmp|KHR_draco_mesh_compression")
_ROUNDING = 1e-3
_REMEDY = "export the file again without these, for example from Blender"


def read_gltf(content: bytes, kind: str, resolver: Resolver) -> trimesh.Scene:
    """Read the scene of a glTF file of the `kind` "gltf" or "glb".

    - `resolver`: opens the other files to which this file refers.

    **Raises:** `ValueError` if the file has features that trimesh does not read, or if the number or the bounds of the
    meshes that trimesh reads differ from those in the file's header.
    """
    text = content[20 : 20 + struct.unpack("<I", content[12:16])[0]] if kind == "glb" else content
    header = json.loads(text)
    unsupported = sorted(set(_unsupported_features(header)))
    require(not unsupported, f"has {', '.join(unsupported)}, which trimesh does not read: {_REMEDY}")
    scene = trimesh.load_scene(BytesIO(content), kind, resolver, process=False)
    # trimesh returns geometries in the order of the file's primitives.
    primitives = [(index, part) for index, part in _primitives(header) if part.get("mode", 4) in _READABLE]
    require(
        len(primitives) == len(scene.geometry),
        f"has {len(primitives)} primitives, but trimesh reads {len(scene.geometry)}",
    )
    boxes: dict[int, list[Float[np.ndarray, "8 3"]]] = {}
    for (index, part), geometry in zip(primitives, scene.geometry.values(), strict=True):
        if part.get("mode", 4) not in _TRIANGLES:
            continue
        accessor = header["accessors"][part["attributes"]["POSITION"]]
        if accessor.get("normalized"):
            geometry.vertices = geometry.vertices / _DIVISORS[accessor["componentType"]]
        bounds = np.array([geometry.vertices.min(axis=0), geometry.vertices.max(axis=0)])
        if "min" in accessor and "max" in accessor:
            largest = _DIVISORS[accessor["componentType"]] if accessor.get("normalized") else 1.0
            header_bounds = np.array([accessor["min"], accessor["max"]]) / largest
            require(
                np.allclose(bounds, header_bounds, rtol=0.0, atol=_ROUNDING * np.abs(header_bounds).max()),
                f"declares that mesh {index} spans {header_bounds.tolist()}, but trimesh reads {bounds.tolist()}: "
                "it is damaged, or stored in a way that trimesh does not read; export it again",
            )
        boxes.setdefault(index, []).append(trimesh.bounds.corners(bounds))
    expected = [
        trimesh.transform_points(box, matrix) for index, matrix in _mesh_nodes(header) for box in boxes.get(index, [])
    ]
    bounds_read = [part.bounds for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    require(
        len(bounds_read) == len(expected),
        f"places {len(expected)} meshes, but trimesh reads {len(bounds_read)}: export it again",
    )
    if bounds_read:
        low, high = np.min(expected, axis=(0, 1)), np.max(expected, axis=(0, 1))
        slack = _ROUNDING * np.abs([low, high]).max()
        extent = np.min(bounds_read, axis=0)[0], np.max(bounds_read, axis=0)[1]
        require(
            bool((extent[0] >= low - slack).all() and (extent[1] <= high + slack).all()),
            f"places its meshes within {low.tolist()} to {high.tolist()}, but trimesh within {extent[0].tolist()} to "
            f"{extent[1].tolist()}: apply the nodes' transforms and export it again",
        )
    return scene


def _unsupported_features(header: dict[str, Any]) -> Iterator[str]:
    """Yield the names of features in a file that change the shape but that trimesh ignores."""
    yield from (name for name in header.get("extensionsRequired", []) if not _HARMLESS.search(name))
    for node in header.get("nodes", []):
        if "mesh" in node and "skin" in node:
            yield "a skeleton (apply the armature)"
        children = [header["nodes"][child] for child in node.get("children", [])]
        if "camera" in node and any("mesh" in child_node for child_node in [node, *children]):
            yield "a mesh below a camera (clear its parent)"
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            yield "EXT_mesh_gpu_instancing"
    weights = [entry.get("weights", []) for name in ("nodes", "meshes") for entry in header.get(name, [])]
    if any(weight for row in weights for weight in row):
        yield "shape keys (apply them)"
    no_draco = importlib.util.find_spec("DracoPy") is None
    for _, part in _primitives(header):
        accessors = part["attributes"].get("POSITION"), part.get("indices")
        if any("sparse" in header["accessors"][index] for index in accessors if index is not None):
            yield "sparse accessors"
        if no_draco and "KHR_draco_mesh_compression" in part.get("extensions", {}):
            yield "Draco compression (pip install DracoPy)"
        if part.get("mode", 4) == _FANS:
            yield "fans of triangles"


def _primitives(header: dict[str, Any]) -> list[tuple[int, dict[str, Any]]]:
    return [(index, part) for index, mesh in enumerate(header.get("meshes", [])) for part in mesh["primitives"]]


def _mesh_nodes(header: dict[str, Any]) -> Iterator[tuple[int, Float[np.ndarray, "4 4"]]]:
    """Yield the mesh index and the mesh-to-scene matrix of each node of the scene that has a mesh."""
    scenes = header.get("scenes", [])
    roots = scenes[header.get("scene", 0)].get("nodes", []) if scenes else []
    stack = [(root, np.eye(4)) for root in roots]
    while stack:
        index, matrix = stack.pop()
        node = header["nodes"][index]
        local_matrix = np.array(node.get("matrix", np.eye(4).ravel()), np.float64).reshape(4, 4).T
        x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
        rotation = trimesh.transformations.quaternion_matrix((w, x, y, z))
        translation = trimesh.transformations.translation_matrix(node.get("translation", (0.0, 0.0, 0.0)))
        matrix = matrix @ local_matrix @ translation @ rotation @ np.diag([*node.get("scale", (1.0, 1.0, 1.0)), 1.0])
        if "mesh" in node:
            yield node["mesh"], matrix
        stack += [(child, matrix) for child in node.get("children", [])]
