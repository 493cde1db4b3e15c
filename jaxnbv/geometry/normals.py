"""Estimation of normals from planes that are fitted to the neighbours of each point."""

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
    """Estimate the unit normals of a surface at points on it, directed towards the sensor.

    The normal of a point is that of the least-squares plane through its nearest neighbours. For a depth image, use
    `PointCloud.from_depth`, which takes the noise of the image into account.

    - `viewpoint`: position of the sensor, either one for all points or one per point, in the coordinates of the points.
    - `neighbours`: number of points that define a plane, the point included. More points smooth noise, but also edges.

    **Raises:** `ValueError` for wrong shapes, fewer points than `neighbours`, fewer than three neighbours, a point or
    viewpoint that is not finite, or a point at the viewpoint.
    """
    points = as_numbers(points, "the points", np.float64)
    sensor = as_numbers(viewpoint, "the viewpoint", np.float64)
    require(points.ndim == 2 and points.shape[1] == 3, f"the points have shape {points.shape}: give (n, 3)")
    require(sensor.shape in ((3,), points.shape), f"the viewpoint has shape {sensor.shape}: give (3,) or one per point")
    require(
        3 <= neighbours <= len(points),
        f"cannot fit planes to {neighbours} of {len(points)} points: take three at least, and no more than there are",
    )
    require(bool(np.isfinite(points).all() and np.isfinite(sensor).all()), "a point or the viewpoint is not finite")
    to_sensor = sensor - points
    require(bool((np.linalg.norm(to_sensor, axis=1) > 0).all()), "a point lies where the sensor stands: drop it")
    _, index = cKDTree(points).query(points, neighbours)
    offsets = points[index] - points[index].mean(axis=1, keepdims=True)
    # `eigh` returns eigenvalues in ascending order, so the points vary least in the first direction.
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))
    normals = directions[:, :, 0]
    return np.where(np.sum(normals * to_sensor, axis=1, keepdims=True) < 0, -normals, normals)
