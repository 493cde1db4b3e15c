"""What a session says of what it was given: a box that cuts the object, a table, views that are worth nothing."""

import math
import warnings

import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.volume import Box

# Of the points, as for a volume that holds the object: fewer may be stray.
_STRAY = 0.01
# Where a session's method was called: from its warning, past the method, which for `add` is in a wrapper of checks.
_CALLER, _CALLER_OF_ADD = 3, 4


def warn_of_cut(box: Box, points: Float[np.ndarray, "n 3"], voxel: float, told: frozenset[str]) -> frozenset[str]:
    """Warn of faces that the object seems to go on beyond; the faces that were told of so far.

    - `box`, `points`, and `voxel`, the side of a cell of the planner's grid: in world units. What lies beyond a face is
      kept within about a voxel of it.
    """
    shares = {face: share for face, share in box.passed(points, 0.5 * voxel).items() if share >= _STRAY}
    for face in sorted(shares.keys() - told):
        warnings.warn(
            f"the object seems to go on beyond the box at {face}: {100 * shares[face]:.0f} % of the points lie within "
            "a voxel beyond that face. Give a larger box, unless it is to cut the object",
            stacklevel=_CALLER_OF_ADD,
        )
    return told.union(shares)


def warn_of_table(point: Float[np.ndarray, "3"]) -> None:
    """Warn of a plane that was taken for a table. `point`: on it, in world units."""
    warnings.warn(
        f"the object stands on a plane through {np.round(point, 4).tolist()}, which goes on beyond the box: it is "
        "taken for a table and left out. Give obstacles=Obstacles() to keep it",
        stacklevel=_CALLER_OF_ADD,
    )


def warn_of_blank() -> None:
    """Warn of an image that measured nothing."""
    warnings.warn(
        "the image measured nothing (all pixels are invalid, or of one value beyond the object) and is left out: take "
        "it again, from farther away or with another exposure",
        stacklevel=_CALLER_OF_ADD,
    )


def warn_of_little(value: float, error: float | None, in_vain: float) -> None:
    """Warn of a best view that may be worth nothing: of candidates that look elsewhere, or once all has been seen.

    - `value`, its standard `error` and what is expected `in_vain` are in world units.
    """
    known = error is not None and math.isfinite(error)
    if value <= (3.0 * error if known and error is not None else 0.0) + in_vain:
        sure = f" ± {error:.2g}" if known else ""
        vain = f", and so much as {in_vain:.2g} is expected where cameras were" if in_vain > 0 else ""
        warnings.warn(
            f"the best view is worth {value:.3g}{sure}{vain}: none is sure to show anything new. Stop, or give poses "
            "that look at the box from elsewhere",
            stacklevel=_CALLER,
        )
