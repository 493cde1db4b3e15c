"""All views of an episode in one picture, and the style of figures."""

from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import NullLocator

from jaxnbv.geometry.camera import Camera
from jaxnbv.viz.choice_figures import draw_acquisition
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.layout import fitted, flow
from jaxnbv.viz.render import Still, draw_scene
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, INK, NEW, bar_ticks, middle_range

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
_ROW = 5.0
_STILL = 640
_POINTS = [("● points before", BEFORE), ("● new points and camera", NEW)]
DEVIATION_LABEL = "standard deviation of the surface (scene units)"


def deviation_range(data: ReportData) -> tuple[float, float]:
    """One range of standard deviations for all views."""
    all_views = [view.surface.deviation for view in data.views if view.surface is not None]
    return middle_range(np.concatenate(all_views)) if all_views else (1e-3, 1.0)


class Stills:
    """The painted surfaces, once they are asked for."""

    def __init__(self, data: ReportData):
        self._data = data
        self._stills: dict[int, Still] = {}

    def __getitem__(self, index: int) -> Still:
        if index not in self._stills:
            stage, surface = self._data.stage, self._data.views[index].surface
            still = self._stills[index] = Still(stage.eye, surface, _STILL, stage.extent)
            still.paint(LogNorm(*deviation_range(self._data)))
        return self._stills[index]


def _deviation_bar(
    figure: Figure | SubFigure, place: tuple[float, float, float, float], norm: LogNorm, size: float = 9.0
) -> None:
    bar = figure.colorbar(ScalarMappable(norm, DEVIATION), cax=figure.add_axes(place), orientation="horizontal")
    bar.outline.set_visible(False)
    ticks = bar_ticks(*bar.ax.get_xlim())
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.ax.tick_params(labelsize=size)
    # Under the numbers, which are as high as their letters and stand off the bar by half as much.
    below = place[1] - 2.6 * size / 72.0 * figure.dpi / figure.bbox.height
    fitted(
        figure,
        place[0] + 0.5 * place[2],
        below,
        DEVIATION_LABEL,
        min(1.3 * place[2], 0.96),
        size,
        ha="center",
        va="center",
    )


def overview_figure(data: ReportData, camera: Camera, stills: Stills | None = None) -> Figure:
    """Scenes over acquisition maps, at most five to a row, and what their marks and colours mean."""
    stills = Stills(data) if stills is None else stills
    columns = min(len(data.views), 5)
    rows, width = -(-len(data.views) // columns), max(3.0 * columns, 6.0)
    marks = [*_POINTS, ("★ chosen view", NEW), ("× visited views", INK)]
    choices = [view.choice for view in data.views if view.choice is not None]
    marks += [("◯ level with the best", INK)] * any(choice.rings_tied for choice in choices)
    marks += [("○ start, ● end of an ascent", INK)] * any(choice.ascents is not None for choice in choices)
    foot = 1.3 + 0.26 * -(-len(marks) // int(0.5 * width))
    figure = Figure(figsize=(width, _ROW * rows + foot))
    heights, whole = [*[_ROW] * rows, foot], {"left": 0, "right": 1, "bottom": 0, "top": 1}
    grid = figure.add_gridspec(rows + 1, columns, **whole, hspace=0, wspace=0, height_ratios=heights)
    for index, view in enumerate(data.views):
        part = figure.add_subfigure(grid[divmod(index, columns)])
        draw_scene(part.add_axes((0.0, 0.32, 1.0, 0.6)), data, index, stills[index], camera, weight=1.3)
        part.text(0.04, 0.95, f"View {view.number}", fontsize=15, fontweight="bold", va="center")
        seen = f"{view.seen.amount}{' seen' * view.seen.is_share}"
        part.text(0.96, 0.95, seen, fontsize=14, ha="right", va="center")
        draw_acquisition(part.add_axes((0.03, 0.01, 0.94, 0.3)), view.choice, data.quantity, weight=1.2)
    below = figure.add_subfigure(grid[rows, :])
    _deviation_bar(below, (0.15, 1.0 - 0.25 / foot, 0.7, 0.13 / foot), LogNorm(*deviation_range(data)), 12.0)
    fitted(below, 0.04, 1.0 - 1.0 / foot, f"Maps: {data.quantity.name}; dark is high", 0.92, 12.0, va="center")
    flow(below, marks, 0.04, 1.0 - 1.28 / foot, 0.92, 0.26 / foot, 12.0)
    return figure
