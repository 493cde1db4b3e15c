"""Warnings of a session, for example that the box cuts the object or that a plane counts as a table."""

import math
import warnings

import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.alignment import Alignment, errors_of
from jaxnbv.planning.table import plane_of
from jaxnbv.scanning import Obstacles

# Smallest fraction of points beyond a face of the box that leads to a warning. Fewer points may be stray.
_MIN_FRACTION = 0.01
# `stacklevel` that points at the user's call: one more for `add`, whose arguments a wrapper checks.
_CALLER, _CALLER_OF_ADD = 3, 4


def warn_of_cut(box: Box, points: Float[np.ndarray, "n 3"], voxel: float, faces: frozenset[str]) -> frozenset[str]:
    """Warn about faces of the box that seem to cut the object. Return the faces of all warnings so far.

    - `points`, `voxel`: measured points in the box and up to about a voxel outside, and the voxel size, in world units.
    - `faces`: faces of earlier warnings, which are not repeated.
    """
    fractions = box.shares_beyond(points, 0.5 * voxel)
    fractions = {face: fraction for face, fraction in fractions.items() if fraction >= _MIN_FRACTION}
    for face in sorted(fractions.keys() - faces):
        warnings.warn(
            f"the object seems to go on beyond the box at {face}: {100 * fractions[face]:.0f} % of the points lie "
            "within a voxel beyond that face. Give a larger box, unless this one should cut the object",
            stacklevel=_CALLER_OF_ADD,
        )
    return faces.union(fractions)


def warn_of_table(table: Obstacles, frame: Frame) -> None:
    """Warn that the session takes a plane for a table. `table` is one half space, in scene coordinates."""
    point, normal = plane_of(table, frame)
    warnings.warn(
        f"the object stands on a plane through {np.round(point, 4).tolist()} with the normal "
        f"{np.round(normal, 3).tolist()}: it is taken for a table and left out. Give obstacles=Obstacles() to keep it",
        stacklevel=_CALLER_OF_ADD,
    )


def warn_of_blank() -> None:
    """Warn that an image has no measurement."""
    warnings.warn(
        "the image measured nothing (all pixels are invalid, or of one value beyond the object) and is left out: take "
        "it again, from farther away or with another exposure",
        stacklevel=_CALLER_OF_ADD,
    )


def warn_of_no_table(up: str, others: tuple[str, ...]) -> None:
    """Warn that no table was detected with the axis `up`. Name `others`, the axes that would give one."""
    if others:
        axes = " or ".join(f'up="{axis}"' for axis in others)
        problem = f'no table is found with up="{up}", but a plane would be one with {axes}: give that if it is upward'
    else:
        problem = f'no table is found under the box with up="{up}", so points of a table may count as the object\'s'
    warnings.warn(
        f"{problem}. Give the table as obstacles=Obstacles((sdf.HalfSpace(point, normal),)) in world units, or "
        "obstacles=Obstacles() if there is none",
        stacklevel=_CALLER_OF_ADD,
    )


def warn_of_mount(alignment: Alignment) -> None:
    """Warn that views disagree. The alignment is in world units."""
    angles, shifts = errors_of(alignment.corrections)
    worst = int(np.nanargmax(alignment.disagreement))
    error_text = f"off by {shifts.max():.2g} and {np.degrees(angles.max()):.2g} degrees"
    hint = "Session(correct_mount=True) uses the correction"
    if not alignment.is_corrected:
        cause = f"these views do not determine the error of the camera's mount, but {alignment.motion} would"
    elif alignment.is_mount:
        more = "" if alignment.is_determined else f", and {alignment.motion} would determine the error better"
        cause = f"the camera's mount seems {error_text}{more}; {hint}"
    else:
        cause = f"single poses seem {error_text} at most; {hint}"
    warnings.warn(
        f"the views disagree by {alignment.disagreement[worst]:.2g}, where a single view's points scatter by "
        f"{alignment.noise:.2g}: {cause}",
        stacklevel=_CALLER_OF_ADD + 1,
    )


def warn_of_inside(box: Box, cameras: Float[np.ndarray, "n 3"], candidates: Float[np.ndarray, "m 3"]) -> None:
    """Warn when a camera is inside the box for the first time, but all candidates are outside.

    - `cameras`, `candidates`: positions of the cameras so far and of the candidates, in world units.
    """
    low, high = box.low, box.high
    is_inside, any_inside = (np.all((x > low) & (x < high), axis=1) for x in (cameras, candidates))
    if is_inside[-1] and is_inside.sum() == 1 and not any_inside.any():
        warnings.warn(
            f"the camera at {np.round(cameras[-1], 3).tolist()} stands inside the box, but all {len(candidates)} "
            "candidates stand outside it. To look around inside, as in a room, give poses=..., (n, 4, 4), of places in "
            "the box; to look at an object, give a box about the object alone",
            stacklevel=_CALLER_OF_ADD,
        )


def warn_of_little(value: float, error: float | None, value_at_visited: float) -> None:
    """Warn if even the best view may show nothing new, because all is seen or no candidate shows the rest.

    - `value`, `error`: value of the best view and its standard error, in world units.
    - `value_at_visited`: mean value expected at visited poses, where nothing is new, in world units.
    """
    has_error = error is not None and math.isfinite(error)
    if value <= (3.0 * error if has_error and error is not None else 0.0) + value_at_visited:
        spread = f" ± {error:.2g}" if has_error else ""
        vain = f", while {value_at_visited:.2g} is expected even at earlier poses" if value_at_visited > 0 else ""
        warnings.warn(
            f"the best view is worth {value:.3g}{spread}{vain}: none is sure to show anything new. Stop, or give poses "
            "that look at the box from elsewhere",
            stacklevel=_CALLER,
        )
