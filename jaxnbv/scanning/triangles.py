"""How far from some triangles a point is, and whether they enclose it."""

import numpy as np
from jaxtyping import Float, Int

from jaxnbv.errors import optional


def distance_to_triangles(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """From each point to the nearest triangle."""
    return np.sqrt(optional("igl").point_mesh_squared_distance(points, vertices, faces)[0])


def winding_number(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """How often the triangles wind around each point (Barill et al. 2018): 1 inside a closed mesh, -1 inside one that
    is wound inside out, between them and 0 by a small hole."""
    return np.asarray(optional("igl").fast_winding_number(vertices, faces, points))
