"""Normals of points that came without: those of planes through their neighbours."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, as_numbers, checked, require


@checked
def estimate_normals(
    points: Float[AnyArray, "n 3"],
    viewpoint: Float[AnyArray, "3"] | Float[AnyArray, "n 3"] | tuple | list,
    neighbours: int = 16,
) -> Float[np.ndarray, "n 3"]:
    """Unit normals of points: each of the plane through it and its nearest neighbours by least squares, turned to where
    it was seen from. All in the same coordinates. Of a depth image take `PointCloud.from_depth`, which knows its noise.

    - `viewpoint`: the sensor's place, or that of each point.
    - `neighbours`: how many points make a plane, itself included; more smooth noise, and edges.

    **Raises:** `ValueError` if there are fewer points than that, fewer than three neighbours, a point or place that is
    not finite, or a point where the sensor stands.
    """
    found = as_numbers(points, "the points", np.float64)
    place = as_numbers(viewpoint, "the viewpoint", np.float64)
    require(found.ndim == 2 and found.shape[1] == 3, f"the points have shape {found.shape}: give (n, 3)")
    require(place.shape in ((3,), found.shape), f"the viewpoint has shape {place.shape}: give (3,), or one a point")
    require(
        3 <= neighbours <= len(found),
        f"a plane through {neighbours} of {len(found)} points cannot be fitted: take three at least, and as many as "
        "there are",
    )
    require(bool(np.isfinite(found).all() and np.isfinite(place).all()), "a point or the viewpoint is not finite")
    toward = place - found
    require(bool((np.linalg.norm(toward, axis=1) > 0).all()), "a point lies where the sensor stands: drop it")
    _, index = cKDTree(found).query(found, neighbours)
    around = found[index] - found[index].mean(axis=1, keepdims=True)
    # Eigenvalues ascend: the first direction is the one in which the points vary least.
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normals = directions[:, :, 0]
    return np.where(np.sum(normals * toward, axis=1, keepdims=True) < 0, -normals, normals)
