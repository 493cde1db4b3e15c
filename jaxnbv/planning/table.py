"""Detection of the table plane that an object stands on."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import AXES, Frame
from jaxnbv.geometry.volume import Box
from jaxnbv.scanning import Obstacles
from jaxnbv.scanning.sdf import HalfSpace

# A table is level to within 30 degrees. The noisy normals of its points differ from its normal by at most 40 degrees.
_MIN_LEVEL_COSINE, _MIN_NORMAL_COSINE = np.cos(np.radians(30.0)), np.cos(np.radians(40.0))
# How far a table may be below the box, and how far a point beside the box still counts as near it, as fractions of the
# box's longest side.
_MAX_DEPTH_BELOW, _MAX_SIDE_DISTANCE = 0.25, 0.2
# Largest fraction of the box's points below a table, and smallest number of points outside the box on a table.
_MAX_STRAY_FRACTION, _MIN_POINTS = 0.02, 50
# Largest distance from a plane at which a point counts as on the plane, in scene units.
_TOLERANCE = 0.03
# Number of random planes, and number of points on which each plane is evaluated.
_NUM_PLANES, _NUM_COUNTED = 1000, 3000


class _Points(NamedTuple):
    """Points of an image relative to the middle of a box, with normals and weights.

    - `is_inside`, `is_near_box`: masks of the points in the box, and of points in, under, above or close beside it.
    - `weights`: weights that decrease with the horizontal distance from the middle of the box.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    is_inside: Bool[np.ndarray, " n"]
    is_near_box: Bool[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]

    def select(self, rows: np.ndarray) -> "_Points":
        return _Points(*(values[rows] for values in self))


def table_under(cloud: PointCloud, box: Box) -> Obstacles | None:
    """Return the table under an object as an obstacle; None if no table is detected.

    - `cloud`: points of the whole image, in scene coordinates with y up.
    - `box`: box around the object, in scene coordinates.

    The obstacle is the half space below the table's plane. Its margin is at least three standard deviations of the
    distances between the table's points and the plane, and at least the default margin. RANSAC (Fischler and Bolles
    1981) draws planes through random triples of points, mostly close to the box. Among the planes that can be a table,
    the plane with the most points outside the box is used. A plane can be a table if it satisfies four conditions:

    - It is level to within 30 degrees, so it is not a wall.
    - At the middle of the box it is below the top, and at most a quarter of the box's longest side below the bottom.
    - At most 2 % of the points in the box are below the plane, so it is not the top of an object.
    - At least as many of the points in, under, above and close beside the box are on the plane as below it, so it is
      not the edge of something in the air.
    """
    low, high = box.low, box.high
    side, middle = float((high - low).max()), 0.5 * (low + high)
    image = _points_around(cloud, low, high, side)
    plane = _best_plane(image, low[1] - middle[1] - _MAX_DEPTH_BELOW * side, high[1] - middle[1])
    if plane is None:
        return None
    normal, offset = plane
    height = np.abs(image.points @ normal - offset)
    is_on_table = image.is_near_box & (height <= 4.0 * _TOLERANCE) & (image.normals @ normal >= _MIN_NORMAL_COSINE)
    # Standard deviation of Gaussian noise, from the median absolute deviation.
    deviation = 1.4826 * float(np.median(height[is_on_table]))
    table = Obstacles((HalfSpace(middle + offset * normal, normal),), max(Obstacles().margin, 3.0 * deviation))
    return table if deviation <= _TOLERANCE else None


def plane_of(table: Obstacles, frame: Frame) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return a point and the normal of the plane from `table_under`, in world coordinates."""
    (plane,) = table.solids
    assert isinstance(plane, HalfSpace)
    point, normal = np.asarray(plane.point, np.float64), np.asarray(plane.normal, np.float64)
    return frame.to_world(point), frame.rotation.T @ normal


def other_ups(cloud: PointCloud, box: Box, up: str) -> tuple[str, ...]:
    """Return the axes other than `up` with which a table is detected, for a cloud and box in world units."""
    frames = [Frame.fit(np.array([box.low, box.high]), up=axis) for axis in AXES if axis != up]
    tables = [table_under(frame.to_scene(cloud), frame.to_scene(box)) for frame in frames]
    return tuple(frame.up for frame, table in zip(frames, tables, strict=True) if table is not None)


def _points_around(
    cloud: PointCloud, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], side: float
) -> _Points:
    """Return points relative to the middle of a box with corners `low` and `high` and longest side `side`."""
    points, normals = (rows.astype(np.float64) for rows in cloud.to_numpy())
    is_inside = np.all((points > low) & (points < high), axis=1)
    margin = np.array([_MAX_SIDE_DISTANCE * side, np.inf, _MAX_SIDE_DISTANCE * side])
    is_near_box = np.all((points > low - margin) & (points < high + margin), axis=1)
    points = points - 0.5 * (low + high)
    weights = 1.0 / (1.0 + (points[:, 0] ** 2 + points[:, 2] ** 2) / side**2)
    return _Points(points, normals, is_inside, is_near_box, weights)


def _best_plane(image: _Points, lowest: float, highest: float) -> tuple[Float[np.ndarray, "3"], float] | None:
    """Return the normal n and offset d of the table plane n . x = d; None if no plane can be a table.

    - `lowest`, `highest`: limits of the plane's height at the middle of the box.
    """
    rng = np.random.default_rng(0)
    # Largest difference between the height of a tilted table at a point and at the middle of the box.
    max_rise = np.hypot(image.points[:, 0], image.points[:, 2]) * np.sqrt(1.0 / _MIN_LEVEL_COSINE**2 - 1.0)
    heights = image.points[:, 1]
    rows = np.flatnonzero(
        ~image.is_inside & (image.normals[:, 1] > 0.5) & (heights > lowest - max_rise) & (heights < highest + max_rise)
    )
    if len(rows) < _MIN_POINTS:
        return None
    # To save time, planes are compared on a random subset of the points, drawn by weight.
    weights = image.weights / image.weights.sum()
    subset = image.select(rng.choice(len(weights), min(len(weights), _NUM_COUNTED), replace=False, p=weights))
    triples = rng.choice(rows, (_NUM_PLANES, 3), p=weights[rows] / weights[rows].sum())
    a, b, c = np.moveaxis(image.points[triples], 1, 0)
    normals = np.cross(b - a, c - a)
    normals *= np.sign(normals[:, 1:2]) / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.sum(normals * a, axis=1)
    is_valid = (
        (normals[:, 1] >= _MIN_LEVEL_COSINE)
        & (offsets >= lowest * normals[:, 1])
        & (offsets <= highest * normals[:, 1])
    )
    normals, offsets = normals[is_valid], offsets[is_valid]
    if not is_valid.any():
        return None
    is_on, is_below = _on_and_below(subset, normals, offsets)
    counts = np.where(_is_table(subset, is_on, is_below), (is_on & ~subset.is_inside[:, None]).sum(axis=0), 0)
    best = int(np.argmax(counts))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        is_on, is_below = _on_and_below(image, normal[None], np.array([offset]))
        if not _is_table(image, is_on, is_below)[0] or is_on[~image.is_inside].sum() < _MIN_POINTS:
            return None
        normal, offset = _fit_plane(image.select(is_on[:, 0]))
    is_valid = normal[1] >= _MIN_LEVEL_COSINE and lowest <= offset / normal[1] <= highest
    return (normal, offset) if is_valid else None


def _on_and_below(
    image: _Points, normals: Float[np.ndarray, "k 3"], offsets: Float[np.ndarray, " k"]
) -> tuple[Bool[np.ndarray, "n k"], Bool[np.ndarray, "n k"]]:
    """Return two masks (points, planes): whether a point is on a plane, and whether it is below the plane."""
    height = image.points @ normals.T - offsets
    return (np.abs(height) <= _TOLERANCE) & (image.normals @ normals.T >= _MIN_NORMAL_COSINE), height < -_TOLERANCE


def _is_table(
    image: _Points, is_on: Bool[np.ndarray, "n k"], is_below: Bool[np.ndarray, "n k"]
) -> Bool[np.ndarray, " k"]:
    """Return, for each plane, whether so few points lie below it that it may be a table.

    This tests the last two conditions of `table_under`.
    """
    is_clear = is_below[image.is_inside].sum(axis=0) <= _MAX_STRAY_FRACTION * image.is_inside.sum()
    return is_clear & (is_on[image.is_near_box].sum(axis=0) >= is_below[image.is_near_box].sum(axis=0))


def _fit_plane(points: _Points) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit the plane y = h + a x + b z (y is up) by weighted least squares. Return its normal and offset."""
    root = np.sqrt(points.weights)
    columns = np.stack([np.ones(len(root)), points.points[:, 0], points.points[:, 2]], axis=1)
    height, slope_x, slope_z = np.linalg.lstsq(root[:, None] * columns, root * points.points[:, 1])[0]
    normal = np.array([-slope_x, 1.0, -slope_z])
    length = float(np.linalg.norm(normal))
    return normal / length, height / length
