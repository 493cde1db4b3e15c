"""Finds which common unit recorded depth images have: the one with which overlapping frames agree."""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, UInt16

from jaxnbv.geometry.camera import Camera

UNITS_A_METRE = (1000.0, 5000.0, 10000.0, 4000.0, 6553.5, 1.0)
"""Common units of depth images, each as the number of units per metre. 1 is for images in the unit of the world."""

# Number of pairs of frames, cosine of the largest angle between the viewing directions of a pair, number of pixels used
# of each frame, and relative difference up to which depths count as equal.
_PAIRS, _SAME_WAY, _PIXELS, _ALIKE = 12, math.cos(math.radians(45.0)), 2000, 0.02
# Least fraction of the points that must agree with the best unit, and least ratio of the number of these points to the
# number for the second-best unit.
_ENOUGH, _CLEAR = 0.03, 2.0


def depth_unit(
    image: Callable[[int], UInt16[np.ndarray, "h w"]], matrices: Float[np.ndarray, "n 4 4"], camera: Camera
) -> float | None:
    """Return the length of the images' unit in world units, or None if the frames do not determine it.

    For each common unit, projects the points of a frame into a second frame, which has a similar viewing direction and
    a different position. With the right unit, the depths of the projected points agree with the second image.

    - `image`: returns the depth image of a frame, 0 where nothing was measured.
    - `matrices`: poses of the frames, camera to world, OpenCV's axes.
    """
    scales = 1.0 / np.array(UNITS_A_METRE)
    alike, total = np.zeros(len(scales)), 0
    places, ahead = matrices[:, :3, 3], matrices[:, :3, 2]
    stride = math.ceil(math.sqrt(camera.num_rays / _PIXELS))
    rays, rows = np.asarray(camera.strided(stride).pixel_directions(), np.float64), slice(stride // 2, None, stride)
    for first in np.unique(np.linspace(0, len(matrices) - 1, _PAIRS).astype(int)):
        second = int(np.argmax(np.linalg.norm(places - places[first], axis=1) * (ahead @ ahead[first] > _SAME_WAY)))
        depth, other = image(int(first))[rows, rows].reshape(-1).astype(float), image(second).astype(float)
        points = (depth[:, None] * rays)[depth > 0]
        move = np.linalg.inv(matrices[second]) @ matrices[first]
        total += len(points) if second != first else 0
        for index, scale in enumerate(scales):
            moved = scale * points @ move[:3, :3].T + move[:3, 3]
            moved = moved[moved[:, 2] > 0]
            column, row = np.floor(camera.to_pixels(moved[:, :2] / moved[:, 2:])).T
            within = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            measured = scale * other[row[within].astype(int), column[within].astype(int)]
            near = np.abs(measured - moved[within, 2]) < _ALIKE * moved[within, 2]
            alike[index] += np.sum(near & (measured > 0)) if second != first else 0
    *_, next_best, best = np.sort(alike)
    return float(scales[np.argmax(alike)]) if best > max(_ENOUGH * total, _CLEAR * next_best) else None
