"""Host code that finds the first triangle on each ray, by Embree or, where it has no wheel, by libigl."""

import importlib
import weakref
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

from jaxnbv.errors import optional

# libigl treats a ray as parallel to a triangle if twice the triangle's area times the cosine of incidence is below
# 1e-6, so lengths are scaled up. libigl also misses the triangles of an edge that a ray meets exactly, so rays are
# shifted by 1e-9 in a direction that edges are unlikely to have.
_SCALE = 2.0**20
_SHIFT = 1e-10 * np.array([3.1, 7.7, 5.5])

FirstFaces: TypeAlias = Callable[
    [Float[np.ndarray, "rays 3"], Float[np.ndarray, "rays 3"]],
    tuple[Int[np.ndarray, " rays"], Float[np.ndarray, " rays"]],
]
"""A function that takes origins and unit directions of rays. It returns the row of the face that each ray hits first
(-1 if the ray misses) and the distance to this face."""


def first_faces(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> FirstFaces:
    """Return a function that finds the first triangle on each ray, and its distance, see `FirstFaces`.

    **Raises:** `ValueError` if neither Embree nor libigl is installed.
    """
    return (_by_embree if tracer() == "embreex" else _by_libigl)(vertices, faces)


def tracer() -> str:
    """Return the name of the package that traces rays on this machine: `embreex` or `libigl`."""
    try:
        importlib.import_module("embreex.rtcore_scene")
    except ImportError:
        return "libigl"
    return "embreex"


def _by_embree(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> FirstFaces:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene(robust=True)
    TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))

    def first(origins, directions):
        hits = scene.run(origins.astype(np.float32), directions.astype(np.float32), output=1)
        return hits["primID"], hits["tfar"]

    return first


def _by_libigl(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> FirstFaces:
    corners, rows = _SCALE * np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    trees = [optional("igl").AABB()]
    trees[0].init(corners, rows)

    def first(origins, directions):
        indices, distances, _ = trees[0].intersect_ray_first(corners, rows, _SCALE * (origins + _SHIFT), directions)
        return indices, distances / _SCALE

    # The tree is freed with the function or at exit. If it outlived Python, a leak would be reported on standard error.
    weakref.finalize(first, trees.clear)
    return first
