"""The plane that an object stands on."""

import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.volume import Box
from jaxnbv.scanning.sdf import HalfSpace

# A table goes on beside the box, by so much of the box's longest side at least, and may lie so little below it. Of the
# points beside the box most are on it, of those in the box none is below it, and so many of all are on it.
_BESIDE, _BELOW = 0.2, 0.05
_MOST, _NONE, _SOME = 0.5, 0.02, 50
_LEVEL = np.cos(np.radians(15.0))
_TOLERANCE = 0.03
# Planes that are tried, and points that each is tried on.
_DRAWS, _COUNTED = 500, 5000
# The share of the points that a plane has at least.
_FEWEST = 0.05


def plane_under(cloud: PointCloud, box: Box) -> HalfSpace | None:
    """The plane that an object in a box stands on, and all below it; None where a cloud shows none. In scene
    coordinates, with y up.

    It is the plane of most points in the box and beside it, and level to 15 degrees. It goes on beside the box, which
    the top of a table that *is* the object does not, and no more than 2 % of the points in the box are below it.
    """
    points, _ = cloud.to_numpy()
    low, high = np.array(box.low), np.array(box.high)
    side = float((high - low).max())
    beside, below = side * _BESIDE * np.array([1.0, 0.0, 1.0]), side * _BELOW * np.array([0.0, 1.0, 0.0])
    near = points[((points > low - beside - below) & (points < high + beside)).all(axis=1)].astype(np.float64)
    inside = ((near > low - below) & (near < high)).all(axis=1)
    if min(inside.sum(), (~inside).sum()) < _SOME:
        return None
    plane = _plane_of_most(near)
    if plane is None:
        return None
    point, normal = plane
    normal = np.sign(normal[1]) * normal
    height = (near - point) @ normal
    on = np.abs(height) <= _TOLERANCE
    found = (
        normal[1] >= _LEVEL
        and on[~inside].sum() >= _SOME
        and on[~inside].mean() >= _MOST
        and (height[inside] < -_TOLERANCE).mean() <= _NONE
    )
    return HalfSpace(point, normal) if found else None


def _plane_of_most(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """A point and the normal of it, by RANSAC (Fischler and Bolles 1981): of planes through three points drawn at
    random the one that most points are near, then the best fit to these. None where all lie on a line, or fewer than a
    twentieth are near."""
    draw = np.random.default_rng(0)
    a, b, c = np.moveaxis(points[draw.integers(0, len(points), (_DRAWS, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    few = draw.choice(points, min(len(points), _COUNTED), replace=False)
    near = np.abs(few @ normals.T - np.sum(a * normals, axis=1)) <= _TOLERANCE
    # Three points on a line have no normal.
    best = np.argmax(np.where(normals.any(axis=1), near.sum(axis=0), -1))
    on = points[np.abs((points - a[best]) @ normals[best]) <= _TOLERANCE]
    if not normals[best].any() or len(on) < max(3, _FEWEST * len(points)):
        return None
    middle = on.mean(axis=0)
    return middle, np.linalg.eigh((on - middle).T @ (on - middle))[1][:, 0]
