"""The heat study's chart as a PNG file: how near the estimated coldest point comes, view by view."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.experiments.heat.report import ESTIMATES, UNITS, Record, estimate_means, methods_of
from jaxnbv.experiments.looks import LOOKS, draw_legend, line_of
from jaxnbv.experiments.statistics import Estimate
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import LINE, log_ticks

_CHARTED = {"distance": "Distance to the coldest points", "error": "Error of the lowest temperature"}
_AMONG = {"all": "all points", "reached": "points the source warms"}
# Methods side by side, so that equal means do not hide one another.
_DODGE = 0.06


def write_figures(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write `coldest.png` into a folder and return its path: distance and temperature error by view, means over scenes
    with bootstrap bands, of the estimate among all points above and among those that the source warms below.

    **Raises:** `ValueError` if there are no records, no method that all of them hold, or their numbers of views differ.
    """
    methods, folder = methods_of(records), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.4, 5.2), layout="constrained")
        panels = figure.subplots(len(ESTIMATES), len(_CHARTED), sharex=True, sharey="col")
        for row, estimate in zip(panels, ESTIMATES, strict=True):
            for axes, (quantity, title) in zip(row, _CHARTED.items(), strict=True):
                _draw(axes, estimate_means(records, methods, quantity, estimate), methods)
                axes.set_title(f"{title}:\ncoldest of {_AMONG[estimate]}")
                axes.set_ylabel(UNITS[quantity])
        for axes in panels[:, 0]:
            axes.set_ylim(0.0, None)
        # The first view holds little but what is heated: an error of many times the later ones.
        for axes in panels[:, 1]:
            axes.set_yscale("log")
        for axes in panels[:, 1]:
            ticks = log_ticks(*axes.get_ylim()).tolist()
            axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
            axes.minorticks_off()
        for axes in panels[-1]:
            axes.set_xlabel("view")
        draw_legend(figure, methods)
        figure.savefig(folder / "coldest.png", dpi=200)
    return [folder / "coldest.png"]


def _draw(axes: Axes, estimate: Estimate, methods: Sequence[str]) -> None:
    """Bands as bars at the views: filled between the views, those of seven methods would hide one another."""
    for index, (method, mean, low, high) in enumerate(zip(methods, *estimate, strict=True)):
        views = np.arange(1, len(mean) + 1) + _DODGE * (index - 0.5 * (len(methods) - 1))
        axes.vlines(views, low, high, color=LOOKS[method].colour, alpha=0.35, lw=2.4, zorder=1)
        axes.plot(views, mean, **line_of(method), zorder=2 + (method == "heat"))
    count = estimate.mean.shape[1]
    axes.set(xlim=(0.6, count + 0.4), xticks=range(1, count + 1))
    axes.grid(axis="y", color=LINE, lw=0.6)
    axes.set_axisbelow(True)
