"""Detection of parts of a bank that no scan can distinguish, because their shape and size are equal."""

import itertools
import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from jaxnbv.surfaces.mesh_shapes import MeshShape

# Number of random points, and the distance from the surface (in grid cells) within which points are compared.
_NUM_PROBES, _MAX_DISTANCE = 8192, 3.0
# Number of pairs that a warning names.
_NUM_NAMED = 5
# Parts are compared in all rotations of a cube onto itself, because files may store equal parts along different axes.
_ROTATIONS = Rotation.create_group("O").as_matrix()


def warn_of_look_alikes(
    shapes: Sequence[MeshShape], names: Sequence[str], sizes: Float[np.ndarray, " k"], stacklevel: int
) -> None:
    """Warn of all pairs of parts that are equal to within a grid cell, up to rotations by right angles.

    - `sizes`: world units per unit of each shape.
    """
    grids, pairs = [_Grid(shape) for shape in shapes], []
    for one, other in itertools.combinations(range(len(shapes)), 2):
        gap = _difference(grids[one], grids[other], float(sizes[other] / sizes[one]))
        if gap < grids[one].spacing:
            pairs.append(f"{names[one]} and {names[other]} (up to {gap * sizes[one]:.2g})")
    if pairs:
        others = f" and {len(pairs) - _NUM_NAMED} other pairs" if len(pairs) > _NUM_NAMED else ""
        warnings.warn(
            f"these parts are the same: {', '.join(pairs[:_NUM_NAMED])}{others}. No view will tell them apart. Leave "
            "one of each pair out, or raise the resolution if they differ by a detail that is smaller than a cell",
            stacklevel=stacklevel + 1,
        )


class _Grid:
    """Signed distances of a shape, interpolated linearly from its grid, and half the shape's side lengths."""

    def __init__(self, shape: MeshShape):
        solid = shape.solid
        self.values, self.low, self.spacing = (np.asarray(each) for each in (solid.values, solid.low, solid.spacing))
        self.half_sides = np.abs(shape.extremes).max(axis=0)

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        indices = ((points - self.low) / self.spacing).T
        return map_coordinates(self.values, indices, order=1, mode="nearest")


def _difference(one: _Grid, other: _Grid, ratio: float) -> float:
    """Return the largest difference between the signed distances of two shapes, near the surface of `one`.

    Both shapes are centred. The shape `other` is scaled by `ratio`, and rotated by the right angles for which the
    difference is smallest. The result is infinite if the side lengths differ in every rotation.
    """
    smallest, points = np.inf, None
    for rotation in _ROTATIONS:
        if np.abs(ratio * np.abs(rotation) @ other.half_sides - one.half_sides).max() > 0.5 * one.spacing:
            continue
        if points is None:
            probes = np.random.default_rng(0).uniform(-1.0, 1.0, (_NUM_PROBES, 3)) * (one.half_sides + one.spacing)
            points = probes[np.abs(one(probes)) < _MAX_DISTANCE * one.spacing]
        smallest = min(smallest, float(np.abs(one(points) - ratio * other(points @ rotation / ratio)).max()))
    return smallest
