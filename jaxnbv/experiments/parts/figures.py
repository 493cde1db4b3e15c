"""The part study's chart: how many views until all parts are found, and of how many objects by view."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.experiments.looks import LOOKS, draw_legend, line_of
from jaxnbv.experiments.parts.report import Record, found_share, methods_of, time_rows, views_of
from jaxnbv.experiments.parts.study import TARGETS
from jaxnbv.experiments.statistics import bootstrap_mean
from jaxnbv.experiments.tables import count_of
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import LINE

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
        draw_legend(figure, methods)
        figure.savefig(folder / "parts.png", dpi=200)
    return [folder / "parts.png"]


def _draw_times(axes: Axes, records: Sequence[Record], methods: Sequence[str]) -> None:
    rows, spacing = time_rows(records), float(TARGETS[1] - TARGETS[0])
    for index, method in enumerate(methods):
        own = [(row["target"], row["mean"], row["standard_error"]) for row in rows if row["method"] == method]
        targets, means, errors = np.array(own, dtype=np.float64).T
        targets = targets + spacing * _dodge(index, len(methods))
        colour = LOOKS[method].colour
        axes.vlines(targets, means - errors, means + errors, color=colour, alpha=0.35, lw=2.4, zorder=1)
        axes.plot(targets, means, **line_of(method), zorder=2 + (method == "discrete"))
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
        axes.vlines(views, 100 * low, 100 * high, color=LOOKS[method].colour, alpha=0.35, lw=2.4, zorder=1)
        axes.plot(views, 100 * mean, **line_of(method), zorder=2 + (method == "discrete"))
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
