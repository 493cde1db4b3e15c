"""Finds the unit of recorded depth images, by comparing overlapping frames for each of the usual units."""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, UInt16

from jaxnbv.geometry.camera import Camera

# Usual units of depth images, each as the number of units per metre. 1 is for images in the unit of the world.
_UNITS_PER_METRE = (1000.0, 5000.0, 10000.0, 4000.0, 6553.5, 1.0)

# Number of pairs of frames, cosine of the largest angle between the viewing directions of a pair, number of pixels of
# the first frame to use, and relative difference up to which depths count as equal.
_NUM_PAIRS, _MIN_COSINE, _NUM_PIXELS, _TOLERANCE = 12, math.cos(math.radians(45.0)), 2000, 0.02
# The best unit is returned only if more than this fraction of the points agree, and more than this many times as many
# as with the second-best unit.
_MIN_FRACTION, _MIN_RATIO = 0.03, 2.0


def depth_unit(
    image: Callable[[int], UInt16[np.ndarray, "h w"]], matrices: Float[np.ndarray, "n 4 4"], camera: Camera
) -> float | None:
    """Return the length of the images' unit in world units, or None if the frames do not determine it.

    For each usual unit, the points of a frame are projected into the most distant frame that looks in a similar
    direction. If the unit is right, the depths of the projected points equal the depths that the second frame measured.
    This is repeated for up to 12 frames, and the unit for which most points agree is chosen.

    - `image`: function from the index of a frame to its depth image, which is 0 where nothing was measured.
    - `matrices`: poses of the frames, camera to world, OpenCV's axes.
    """
    scales = 1.0 / np.array(_UNITS_PER_METRE)
    counts, total = np.zeros(len(scales)), 0
    positions, forward = matrices[:, :3, 3], matrices[:, :3, 2]
    stride = math.ceil(math.sqrt(camera.num_rays / _NUM_PIXELS))
    rays, rows = np.asarray(camera.strided(stride).pixel_directions(), np.float64), slice(stride // 2, None, stride)
    for first in np.unique(np.linspace(0, len(matrices) - 1, _NUM_PAIRS).astype(int)):
        distances = np.linalg.norm(positions - positions[first], axis=1)
        second = int(np.argmax(distances * (forward @ forward[first] > _MIN_COSINE)))
        depth, other = image(int(first))[rows, rows].reshape(-1).astype(float), image(second).astype(float)
        points = (depth[:, None] * rays)[depth > 0]
        motion = np.linalg.inv(matrices[second]) @ matrices[first]
        total += len(points) if second != first else 0
        for index, scale in enumerate(scales):
            second_points = scale * points @ motion[:3, :3].T + motion[:3, 3]
            second_points = second_points[second_points[:, 2] > 0]
            column, row = np.floor(camera.to_pixels(second_points[:, :2] / second_points[:, 2:])).T
            is_inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            depths = scale * other[row[is_inside].astype(int), column[is_inside].astype(int)]
            is_equal = np.abs(depths - second_points[is_inside, 2]) < _TOLERANCE * second_points[is_inside, 2]
            counts[index] += np.sum(is_equal & (depths > 0)) if second != first else 0
    *_, next_best, best = np.sort(counts)
    return float(scales[np.argmax(counts)]) if best > max(_MIN_FRACTION * total, _MIN_RATIO * next_best) else None
