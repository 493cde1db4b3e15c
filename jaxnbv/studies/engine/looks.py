"""What methods look like in the charts of all studies."""

import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnbv.studies.engine.measures import UNKNOWING
from jaxnbv.viz.style import GREY, INK


class Look(NamedTuple):
    """Colours that colour-blind readers tell apart (Okabe and Ito); line and marker tell the rest apart in print."""

    colour: str
    line: str
    marker: str


# What is new stands out in vermilion, its variants beside it; baselines have the same look in every study.
_FIRST, _SECOND, _THIRD = Look("#d55e00", "-", "o"), Look("#cc79a7", "-", "v"), Look("#e69f00", "-", "^")
LOOKS = {
    "cross-entropy": _FIRST,
    "new surface": _FIRST,
    "evenly spaced": Look("#cc79a7", "--", "v"),
    "entropy": _SECOND,
    "mixed": _THIRD,
    "tie-break": Look("#a33b00", "--", "h"),
    "discrete": _FIRST,
    "gradient-2dof": _THIRD,
    "gradient-6dof": _SECOND,
    "gradient-constrained": _SECOND,
    "halving": Look("#009e73", "--", "D"),
    "hybrid": Look("#0072b2", "--", "s"),
    "heat": _FIRST,
    "heat-reached": _SECOND,
    "heat-halving": Look("#e69f00", "--", "^"),
    "coverage": Look("#009e73", "-", "D"),
    "farthest": Look("#0072b2", "-", "s"),
    f"coverage{UNKNOWING}": Look("#009e73", ":", "d"),
    f"uncertainty{UNKNOWING}": Look("#56b4e9", ":", "p"),
    "uncertainty": Look("#56b4e9", "-", "P"),
    "random": Look(GREY, "--", "X"),
    "oracle": Look(INK, ":", "*"),
}
# Methods of one's own, in turn.
_OTHERS = (Look("#8c564b", "-", "p"), Look("#7f3fbf", "-", "h"), Look("#b8860b", "--", "d"))
_SIZES = {"*": 8.0, "o": 5.0, "P": 6.0, "X": 6.0}


def line_of(method: str) -> dict[str, Any]:
    """A method's line and markers, as arguments of `Axes.plot`; that of a study's first method is thicker."""
    look = LOOKS.get(method) or _OTHERS[zlib.crc32(method.encode()) % len(_OTHERS)]
    ours = look == _FIRST
    line = {"color": look.colour, "ls": look.line, "lw": 2.0 if ours else 1.2}
    size = _SIZES.get(look.marker, 4.4) * (1.2 if ours else 1.0)
    return line | {"marker": look.marker, "ms": size, "markeredgecolor": "white", "mew": 0.4}


def draw_legend(figure: Figure, methods: Sequence[str]) -> None:
    """The methods, at the right of a figure."""
    handles = [Line2D([], [], label=method, **line_of(method)) for method in methods]
    figure.legend(handles=handles, loc="outside right center", frameon=False, fontsize=9, handlelength=2.6)
