"""The pyramid study's charts as PNG files: the paper's figure, the same by angle, and the diagnostics."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.experiments.looks import LOOKS, draw_legend, line_of
from jaxnbv.experiments.pyramid.report import (
    DIAGNOSTICS,
    METHODS,
    QUANTITIES,
    Record,
    by_angle,
    by_framing,
    diagnostic_rows,
    estimate_shares,
    methods_of,
)
from jaxnbv.experiments.statistics import Estimate
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import GREY, LINE

# Methods side by side, so that equal shares do not hide one another.
_DODGE = 0.055


def write_figures(records: Sequence[Record], folder: str | Path) -> list[Path]:
    """Write for each framing three PNG files into a folder, and return their paths:

    `hits_*.png`: the share of scenes that had a first hit, a stable hit and the pattern in view, by view, with
    bootstrap bands; `angles_*.png`: the same by the angle of the first view; `diagnostics_*.png`, where there are any.

    **Raises:** `ValueError` if there are no records, or their numbers of views differ.
    """
    methods_of(records)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    with mpl.rc_context(STYLE):
        for framing, members in by_framing(records).items():
            bins = by_angle(members)
            figures = {
                "hits": _hits({"all": bins.pop("all")}),
                "angles": _hits(bins),
                "diagnostics": _diagnostics(members),
            }
            for name, figure in figures.items():
                if figure is not None:
                    paths.append(folder / f"{name}_{framing}.png")
                    figure.savefig(paths[-1], dpi=200)
    return paths


def _hits(groups: dict[str, list[Record]]) -> Figure:
    """A row of panels for each group of scenes."""
    methods = methods_of([record for members in groups.values() for record in members])
    figure = Figure(figsize=(8.4, 0.4 + (2.9 if len(groups) == 1 else 2.15 * len(groups))), layout="constrained")
    panels = figure.subplots(len(groups), len(QUANTITIES), sharex=True, sharey=True, squeeze=False)
    for row, (angle, members) in zip(panels, groups.items(), strict=True):
        estimate = estimate_shares(members, methods)
        for axes, *of_quantity in zip(row, *estimate, strict=True):
            _draw_shares(axes, Estimate(*of_quantity), methods)
        scenes = f"{len(members)} scene{'s' if len(members) != 1 else ''}"
        row[0].set_ylabel("share of scenes (%)" if angle == "all" else f"share of {scenes} (%)\nfirst view: {angle}°")
    for axes, name in zip(panels[0], QUANTITIES.values(), strict=True):
        axes.set_title(name.capitalize())
    for axes in panels[-1]:
        axes.set_xlabel("view")
    draw_legend(figure, methods)
    return figure


def _draw_shares(axes: Axes, shares: Estimate, methods: Sequence[str]) -> None:
    """Bands as bars at the views: filled between the views, those of eight methods would hide one another."""
    for index, (method, mean, low, high) in enumerate(zip(methods, *shares, strict=True)):
        views = np.arange(1, len(mean) + 1) + _dodge(index, len(methods))
        axes.vlines(views, 100 * low, 100 * high, color=LOOKS[method].colour, alpha=0.35, lw=2.4, zorder=1)
        axes.plot(views, 100 * mean, **line_of(method), zorder=2 + (method == "cross-entropy"))
    _finish(axes, shares.mean.shape[1])
    axes.set(ylim=(-3, 103), yticks=[0, 25, 50, 75, 100])


def _diagnostics(records: Sequence[Record]) -> Figure | None:
    rows = [row for row in diagnostic_rows(records) if row["angle"] == "all"]
    if not rows:
        return None
    methods = [method for method in METHODS if any(row["method"] == method for row in rows)]
    figure = Figure(figsize=(8.4, 3.0), layout="constrained")
    for axes, (quantity, name) in zip(figure.subplots(1, len(DIAGNOSTICS)), DIAGNOSTICS.items(), strict=True):
        for index, method in enumerate(methods):
            points = [
                (row["view"], row["mean"]) for row in rows if (row["method"], row["quantity"]) == (method, quantity)
            ]
            if points:
                views, means = np.array(points, dtype=np.float64).T
                axes.plot(views + _dodge(index, len(methods)), means, **line_of(method))
        axes.set(xlabel="view being chosen", title=name.capitalize())
        _finish(axes, max(row["view"] for row in rows), first=2)
        if quantity == "rank_correlation":
            axes.axhline(0.0, color=GREY, lw=0.7, zorder=0)
        else:
            axes.set_ylim(0.0, None)
    draw_legend(figure, methods)
    return figure


def _finish(axes: Axes, views: int, first: int = 1) -> None:
    axes.set(xlim=(first - 0.4, views + 0.4), xticks=range(first, views + 1))
    axes.grid(axis="y", color=LINE, lw=0.6)
    axes.set_axisbelow(True)


def _dodge(index: int, count: int) -> float:
    return _DODGE * (index - 0.5 * (count - 1))
