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
_LEVEL, _AGREES = np.cos(np.radians(30.0)), np.cos(np.radians(40.0))
# Largest distances of a table below the box, and of points beside the box, as fractions of the box's longest side.
_BELOW, _BESIDE = 0.25, 0.2
# Largest fraction of the box's points below a table, and smallest number of points outside the box on a table.
_STRAY, _FEWEST = 0.02, 50
# Largest distance from a plane at which a point counts as on the plane, in scene units.
_TOLERANCE = 0.03
# Number of random planes, and number of points on which each plane is evaluated.
_DRAWS, _COUNTED = 1000, 3000


class _Points(NamedTuple):
    """Points of an image relative to the middle of a box, with normals and weights.

    - `inside`: mask of the points in the box.
    - `around`: mask of the points in, under, above or close beside the box.
    - `weights`: weights that decrease with the horizontal distance from the middle of the box.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    inside: Bool[np.ndarray, " n"]
    around: Bool[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]

    def at(self, rows: np.ndarray) -> "_Points":
        return _Points(*(values[rows] for values in self))


def table_under(cloud: PointCloud, box: Box) -> Obstacles | None:
    """Return the half space below the plane that an object stands on; None if no such plane is detected.

    The margin of the returned obstacle is three standard deviations of the plane's points, or the default margin if
    this is larger. RANSAC (Fischler and Bolles 1981) draws planes through random points, which are mostly close to the
    box. Among all planes that can be a table, the plane with the most points outside the box is used. A plane can be a
    table if it satisfies four conditions:

    - It is level to within 30 degrees, so it is not a wall.
    - Its height at the middle of the box is below the top of the box. It is at most a quarter of the box's longest side
      below the bottom.
    - At most 2 % of the points in the box are below the plane, so it is not the top of an object.
    - Of the points in, under, above and close beside the box, at least as many are on the plane as below it. So it is
      not the edge of something in the air.

    Arguments are in scene coordinates with y up.

    - `cloud`: points of the whole image, also outside the box.
    - `box`: box around the object.
    """
    low, high = box.low, box.high
    side, middle = float((high - low).max()), 0.5 * (low + high)
    image = _points_about(cloud, low, high, side)
    plane = _plane_of_most(image, low[1] - middle[1] - _BELOW * side, high[1] - middle[1])
    if plane is None:
        return None
    normal, offset = plane
    height = np.abs(image.points @ normal - offset)
    own = image.around & (height <= 4.0 * _TOLERANCE) & (image.normals @ normal >= _AGREES)
    # Standard deviation of Gaussian noise, from the median absolute deviation.
    deviation = 1.4826 * float(np.median(height[own]))
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


def _points_about(cloud: PointCloud, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], side: float) -> _Points:
    """Return points relative to the middle of a box with corners `low` and `high` and longest side `side`."""
    points, normals = (rows.astype(np.float64) for rows in cloud.to_numpy())
    inside = np.all((points > low) & (points < high), axis=1)
    room = np.array([_BESIDE * side, np.inf, _BESIDE * side])
    around = np.all((points > low - room) & (points < high + room), axis=1)
    points = points - 0.5 * (low + high)
    weights = 1.0 / (1.0 + (points[:, 0] ** 2 + points[:, 2] ** 2) / side**2)
    return _Points(points, normals, inside, around, weights)


def _plane_of_most(image: _Points, lowest: float, highest: float) -> tuple[Float[np.ndarray, "3"], float] | None:
    """Return the normal n and offset d of the table plane n . x = d; None if no plane can be a table.

    Among the planes that can be a table, the plane with the most points outside the box is returned.

    - `lowest`, `highest`: limits of the plane's height at the middle of the box.
    """
    draw = np.random.default_rng(0)
    # Largest difference between the height of a tilted table at a point and at the middle of the box.
    reach = np.hypot(image.points[:, 0], image.points[:, 2]) * np.sqrt(1.0 / _LEVEL**2 - 1.0)
    up = image.points[:, 1]
    rows = np.flatnonzero(~image.inside & (image.normals[:, 1] > 0.5) & (up > lowest - reach) & (up < highest + reach))
    if len(rows) < _FEWEST:
        return None
    # A random subset, drawn by weight, represents all points.
    share = image.weights / image.weights.sum()
    few = image.at(draw.choice(len(share), min(len(share), _COUNTED), replace=False, p=share))
    drawn = draw.choice(rows, (_DRAWS, 3), p=share[rows] / share[rows].sum())
    a, b, c = np.moveaxis(image.points[drawn], 1, 0)
    normals = np.cross(b - a, c - a)
    normals *= np.sign(normals[:, 1:2]) / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = np.sum(normals * a, axis=1)
    can = (normals[:, 1] >= _LEVEL) & (offsets >= lowest * normals[:, 1]) & (offsets <= highest * normals[:, 1])
    normals, offsets = normals[can], offsets[can]
    if not can.any():
        return None
    on, below = _on_and_below(few, normals, offsets)
    count = np.where(_is_table(few, on, below), (on & ~few.inside[:, None]).sum(axis=0), 0)
    best = int(np.argmax(count))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        on, below = _on_and_below(image, normal[None], np.array([offset]))
        if not _is_table(image, on, below)[0] or on[~image.inside].sum() < _FEWEST:
            return None
        normal, offset = _fitted(image.at(on[:, 0]))
    can = normal[1] >= _LEVEL and lowest <= offset / normal[1] <= highest
    return (normal, offset) if can else None


def _on_and_below(
    image: _Points, normals: Float[np.ndarray, "k 3"], offsets: Float[np.ndarray, " k"]
) -> tuple[Bool[np.ndarray, "n k"], Bool[np.ndarray, "n k"]]:
    """Return masks of the points on each plane and of the points below each plane."""
    height = image.points @ normals.T - offsets
    return (np.abs(height) <= _TOLERANCE) & (image.normals @ normals.T >= _AGREES), height < -_TOLERANCE


def _is_table(image: _Points, on: Bool[np.ndarray, "n k"], below: Bool[np.ndarray, "n k"]) -> Bool[np.ndarray, " k"]:
    """Return, for each plane, whether so few points lie below it that it may be a table.

    These are the last two conditions of `table_under`. `on` and `below` are the result of `_on_and_below`.
    """
    free = below[image.inside].sum(axis=0) <= _STRAY * image.inside.sum()
    return free & (on[image.around].sum(axis=0) >= below[image.around].sum(axis=0))


def _fitted(points: _Points) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit the plane y = h + a x + b z (y is up) by weighted least squares. Return its normal and offset."""
    root = np.sqrt(points.weights)
    columns = np.stack([np.ones(len(root)), points.points[:, 0], points.points[:, 2]], axis=1)
    height, across, along = np.linalg.lstsq(root[:, None] * columns, root * points.points[:, 1])[0]
    normal = np.array([-across, 1.0, -along])
    length = float(np.linalg.norm(normal))
    return normal / length, height / length
