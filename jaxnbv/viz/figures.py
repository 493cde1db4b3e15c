"""Draws all views of an episode in one figure. `STYLE` is the style of all figures."""

from typing import Any

from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from jaxnbv.viz.choice import draw_acquisition, marks
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.render import draw_scene, render_view
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, INK, NEW, PART, bar_ticks

STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "figure.facecolor": "white",
}
_ROW_HEIGHT, _LINE_HEIGHT = 5.0, 0.26
# Pixels along each side of a view's picture, which is drawn three inches wide.
_STILL_SIZE = 320


def overview_figure(data: ReportData) -> Figure:
    """Draw each view's scene above its map of the acquisition, at most five views in a row, and a legend."""
    columns = min(len(data.views), 5)
    rows, width = -(-len(data.views) // columns), max(3.0 * columns, 6.0)
    shapes = [("■ scanned", PART), ("■ imagined", "#a5cfc0"), ("■ others disagree", "#b3a9dc")]
    legend = shapes if data.has_shapes else []
    legend += [("● points before", BEFORE), ("● new points and camera", NEW), ("★ chosen view", NEW)]
    legend += [(mark, INK) for mark in marks(*data.proposals)]
    legend_columns = int(width // 3)
    legend_height = 1.3 + _LINE_HEIGHT * -(-len(legend) // legend_columns)
    figure = Figure(figsize=(width, _ROW_HEIGHT * rows + legend_height))
    heights, margins = [*[_ROW_HEIGHT] * rows, legend_height], {"left": 0, "right": 1, "bottom": 0, "top": 1}
    grid = figure.add_gridspec(rows + 1, columns, **margins, hspace=0, wspace=0, height_ratios=heights)
    for index, view in enumerate(data.views):
        panel = figure.add_subfigure(grid[divmod(index, columns)])
        still = render_view(data, index, _STILL_SIZE)
        draw_scene(panel.add_axes((0.0, 0.32, 1.0, 0.6)), data, index, still, weight=1.3)
        panel.text(0.04, 0.95, f"View {index + 1}", fontsize=15, fontweight="bold", va="center")
        coverage_text = f"{view.coverage.amount}{' seen' * (view.coverage.unit == '%')}"
        panel.text(0.96, 0.95, coverage_text, fontsize=14, ha="right", va="center")
        draw_acquisition(panel.add_axes((0.03, 0.01, 0.94, 0.3)), view.proposal, data.quantity, weight=1.2)
    legend_panel = figure.add_subfigure(grid[rows, :])
    if data.has_deviations:
        _draw_deviations(legend_panel.add_axes((0.15, 1.0 - 0.25 / legend_height, 0.7, 0.13 / legend_height)), data)
    maps = f"Maps: {data.quantity.name}; dark is high"
    # Ten letters of size 12 take an inch.
    size = 12.0 * min(1.0, 9.0 * width / len(maps))
    legend_panel.text(0.04, 1.0 - 1.0 / legend_height, maps, fontsize=size, va="center")
    for number, (mark, colour) in enumerate(legend):
        row, column = divmod(number, legend_columns)
        position = 0.04 + 0.94 * column / legend_columns, 1.0 - (1.28 + _LINE_HEIGHT * row) / legend_height
        legend_panel.text(*position, mark, color=colour, fontsize=12, va="center")
    return figure


def _draw_deviations(axes: Any, data: ReportData) -> None:
    low, high = data.deviations
    bar = axes.figure.colorbar(ScalarMappable(LogNorm(low, high), DEVIATION), cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    ticks = bar_ticks(low, high)
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.ax.tick_params(labelsize=12)
    bar.set_label(f"standard deviation of the surface ({data.episode.frame.unit})", fontsize=12)
