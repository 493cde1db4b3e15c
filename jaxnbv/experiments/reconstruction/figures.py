"""The reconstruction study's chart as a PNG file: the table with intervals, and the covered surface by view."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.experiments.looks import LOOKS, draw_legend, line_of
from jaxnbv.experiments.reconstruction.report import Record, distance_rows, estimate_coverage, methods_of
from jaxnbv.experiments.reconstruction.study import RECONSTRUCTIONS
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import LINE

_CHARTED = ("chamfer", "hausdorff")
_NAMES = {"chamfer": "Chamfer distance", "hausdorff": "Hausdorff distance"}


def write_figures(records: Sequence[Record], folder: str | Path) -> Path:
    """Write `reconstruction.png` into a folder and return its path: for each reconstruction the means of Chamfer and
    Hausdorff distance with their bootstrap intervals, and the covered share of the true surface by view.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    methods, folder = methods_of(records), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows = distance_rows(records)
    shown = [name for name in RECONSTRUCTIONS if any(row["reconstruction"] == name for row in rows)]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.6, 2.9), layout="constrained")
        panels = figure.subplots(1, len(_CHARTED) + 1, width_ratios=[1.0] * len(_CHARTED) + [1.1])
        for axes, quantity in zip(panels, _CHARTED, strict=False):
            _draw_distances(axes, [row for row in rows if row["quantity"] == quantity], shown, methods)
            axes.set_title(_NAMES[quantity])
        _draw_coverage(panels[-1], records, methods)
        draw_legend(figure, methods)
        figure.savefig(folder / "reconstruction.png", dpi=200)
    return folder / "reconstruction.png"


def _draw_distances(axes: Axes, rows: list[dict], reconstructions: Sequence[str], methods: Sequence[str]) -> None:
    for place, name in enumerate(reconstructions):
        for index, method in enumerate(methods):
            (row,) = [row for row in rows if (row["reconstruction"], row["method"]) == (name, method)]
            x = place + 0.16 * (index - 0.5 * (len(methods) - 1))
            axes.vlines(x, row["low"], row["high"], color=LOOKS[method].colour, alpha=0.45, lw=3.0)
            axes.plot(x, row["mean"], **line_of(method))
    axes.set(xticks=range(len(reconstructions)), xticklabels=[name.replace(" ", "\n") for name in reconstructions])
    axes.set(xlim=(-0.5, len(reconstructions) - 0.5), ylim=(0.0, None), ylabel="scene units")
    axes.tick_params(axis="x", length=0)
    _rule(axes)


def _draw_coverage(axes: Axes, records: Sequence[Record], methods: Sequence[str]) -> None:
    estimate = estimate_coverage(records, methods)
    for index, (method, mean, low, high) in enumerate(zip(methods, *estimate, strict=True)):
        views = np.arange(1, len(mean) + 1) + 0.06 * (index - 0.5 * (len(methods) - 1))
        axes.vlines(views, 100 * low, 100 * high, color=LOOKS[method].colour, alpha=0.35, lw=2.4)
        axes.plot(views, 100 * mean, **line_of(method))
    axes.set(title="Surface covered", xlabel="view", ylabel="share of the surface (%)", ylim=(0, 103))
    axes.set_xticks(range(1, estimate.mean.shape[1] + 1))
    _rule(axes)


def _rule(axes: Axes) -> None:
    axes.grid(axis="y", color=LINE, lw=0.6)
    axes.set_axisbelow(True)
