"""The part study's chart: how many views until all parts are found, and of how many objects by view."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnbv.experiments.part_report import Record, found_share, methods_of, time_rows, views_of
from jaxnbv.experiments.part_study import TARGETS
from jaxnbv.experiments.statistics import bootstrap_mean
from jaxnbv.experiments.tables import count_of
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import GREY, LINE


class _Look(NamedTuple):
    """Colours that colour-blind readers tell apart (Okabe and Ito); line and marker tell the rest apart in print."""

    colour: str
    line: str
    marker: str


_LOOKS = {
    "discrete": _Look("#d55e00", "-", "o"),
    "gradient-2dof": _Look("#e69f00", "-", "^"),
    "gradient-6dof": _Look("#cc79a7", "-", "v"),
    "farthest": _Look("#0072b2", "-", "s"),
    "uncertainty": _Look("#56b4e9", "-", "P"),
    "random": _Look(GREY, "--", "X"),
    "coverage": _Look("#009e73", "-", "D"),
}
# Methods side by side, so that equal numbers do not hide one another: of the distance between two ticks.
_DODGE = 0.065
# The authors' N_target for the utility; the right panel is for it.
_TARGET = 60


def write_figures(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write `parts.png` into a folder and return its path.

    On the left the mean of T_discovery by N_target with its standard error; on the right the share of the objects whose
    parts all had 60 points, by view, with bootstrap bands over scenes.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    methods, folder = methods_of(records), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 3.1), layout="constrained")
        left, right = figure.subplots(1, 2)
        _draw_times(left, records, methods)
        _draw_shares(right, records, methods)
        handles = [Line2D([], [], label=method, **_line(method)) for method in methods]
        figure.legend(handles=handles, loc="outside right center", frameon=False, fontsize=9, handlelength=2.6)
        figure.savefig(folder / "parts.png", dpi=200)
    return [folder / "parts.png"]


def _draw_times(axes: Axes, records: Sequence[Record], methods: Sequence[str]) -> None:
    rows, spacing = time_rows(records), float(TARGETS[1] - TARGETS[0])
    for index, method in enumerate(methods):
        own = [(row["target"], row["mean"], row["standard_error"]) for row in rows if row["method"] == method]
        targets, means, errors = np.array(own, dtype=np.float64).T
        targets = targets + spacing * _dodge(index, len(methods))
        colour = _LOOKS[method].colour
        axes.vlines(targets, means - errors, means + errors, color=colour, alpha=0.35, lw=2.4, zorder=1)
        axes.plot(targets, means, **_line(method), zorder=2 + (method == "discrete"))
    views = views_of(records)
    axes.set(xlabel="points that every part must have, $N_{target}$")
    axes.set(ylabel=f"$T_{{discovery}}$ (not in {count_of(views, 'view')}: {views + 1})")
    axes.set(xticks=TARGETS, xlim=(TARGETS[0] - 0.5 * spacing, TARGETS[-1] + 0.5 * spacing))
    axes.set_title("Views until all parts are found")
    _rule(axes)


def _draw_shares(axes: Axes, records: Sequence[Record], methods: Sequence[str]) -> None:
    """Bands as bars at the views: filled between the views, those of seven methods would hide one another."""
    shares = bootstrap_mean(found_share(records, methods, _TARGET), np.random.default_rng(0))
    for index, (method, mean, low, high) in enumerate(zip(methods, *shares, strict=True)):
        views = np.arange(1, len(mean) + 1) + _dodge(index, len(methods))
        axes.vlines(views, 100 * low, 100 * high, color=_LOOKS[method].colour, alpha=0.35, lw=2.4, zorder=1)
        axes.plot(views, 100 * mean, **_line(method), zorder=2 + (method == "discrete"))
    count = shares.mean.shape[1]
    axes.set(xlabel="view", ylabel=f"share of {count_of(len(records), 'object')} (%)")
    axes.set(xlim=(0.6, count + 0.4), xticks=range(1, count + 1), ylim=(-3, 103), yticks=[0, 25, 50, 75, 100])
    axes.set_title(f"All parts found, $N_{{target}} = {_TARGET}$")
    _rule(axes)


def _rule(axes: Axes) -> None:
    axes.grid(axis="y", color=LINE, lw=0.6)
    axes.set_axisbelow(True)


def _dodge(index: int, count: int) -> float:
    return _DODGE * (index - 0.5 * (count - 1))


def _line(method: str) -> dict[str, Any]:
    look = _LOOKS[method]
    ours = method == "discrete"
    size = {"o": 5.0, "P": 6.0, "X": 6.0}.get(look.marker, 4.4)
    line = {"color": look.colour, "ls": look.line, "lw": 2.0 if ours else 1.2}
    return line | {"marker": look.marker, "ms": size * (1.2 if ours else 1.0), "markeredgecolor": "white", "mew": 0.4}
