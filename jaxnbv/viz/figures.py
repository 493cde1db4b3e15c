"""The pictures of an episode as PNG files, for papers and READMEs."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator
from PIL import Image

from jaxnbv.acquisition import Quantity
from jaxnbv.geometry.camera import Camera
from jaxnbv.progress import progress_bar
from jaxnbv.storage.files import make_folder, write_whole
from jaxnbv.viz import sphere
from jaxnbv.viz.answers import label_of, number
from jaxnbv.viz.choice import Choice
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.imagined_figures import imagined_figure
from jaxnbv.viz.layout import fitted, flow, pixels_of, width_of
from jaxnbv.viz.render import Still, draw_scene
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, INK, LINE, NEW, VALUE, middle_range, spaced_ticks
from jaxnbv.viz.task_figures import chart_figure, progress_charts, task_charts
from jaxnbv.viz.trajectory_figures import draw_ascents, trajectory_figure

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
_ROW = 5.1
_STILL = 640
_POINTS = [("● points before", BEFORE), ("● new points and camera", NEW)]
DEVIATION_LABEL = "standard deviation of the surface (scene units)"


def deviation_range(data: ReportData) -> tuple[float, float]:
    """One range of standard deviations for all views."""
    all_views = [view.surface.deviation for view in data.views if view.surface is not None]
    return middle_range(np.concatenate(all_views)) if all_views else (1e-3, 1.0)


class Stills:
    """The painted surfaces, once they are asked for: the page, the figures and the strip share them."""

    def __init__(self, data: ReportData):
        self._data = data
        self._stills: dict[int, Still] = {}

    def __getitem__(self, index: int) -> Still:
        if index not in self._stills:
            stage, surface = self._data.stage, self._data.views[index].surface
            still = self._stills[index] = Still(stage.eye, surface, _STILL, stage.extent)
            still.paint(LogNorm(*deviation_range(self._data)))
        return self._stills[index]


def figures_of(data: ReportData, camera: Camera, stills: Stills) -> dict[str, Callable[[], Figure]]:
    """What draws each figure of an episode, by its name: `view_01`, ... scene and acquisition of each view;
    `view_02_imagined`, ... what was imagined before it; `view_02_trajectories`, ... the ascents of a gradient search in
    space, of views that were found among 6-DOF poses; `task` and `coverage`, the charts; `overview`, all views in a
    strip."""
    drawings: dict[str, Callable[[], Figure]] = {}
    for index, view in enumerate(data.views):
        drawings[f"view_{view.number:02d}"] = partial(_view, data, index, camera, stills)
        if view.imagined is not None:
            drawings[f"view_{view.number:02d}_imagined"] = partial(imagined_figure, data, index)
        if view.spatial_ascents is not None:
            drawings[f"view_{view.number:02d}_trajectories"] = partial(trajectory_figure, data, index, camera)
    drawings["task"] = partial(chart_figure, task_charts(data))
    drawings["coverage"] = partial(chart_figure, progress_charts(data))
    drawings["overview"] = partial(overview_figure, data, camera, stills)
    return drawings


def write_figures(
    data: ReportData, camera: Camera, folder: str | Path, progress: bool = True, stills: Stills | None = None
) -> list[Path]:
    """Write the figures of an episode (see `figures_of`) as PNG files into a folder, and return their paths.

    `stills`: painted surfaces, where they are at hand.
    """
    folder = make_folder(folder)
    drawings = figures_of(data, camera, Stills(data) if stills is None else stills)
    with mpl.rc_context(STYLE):
        for name, draw in progress_bar(drawings.items(), progress, desc="drawing figures"):
            small = name == "overview"
            _save(draw(), folder / f"{name}.png", dpi=120 if small else 200, few_colours=small)
    return [folder / f"{name}.png" for name in drawings]


def _save(figure: Figure, path: Path, dpi: int, few_colours: bool = False) -> None:
    image = Image.fromarray(pixels_of(figure, dpi)).convert("RGB")
    if few_colours:
        # A third of the size; dithered, so that the colour bars stay smooth.
        image = image.quantize(palette=image.quantize(256), dither=Image.Dither.FLOYDSTEINBERG)
        colours = np.asarray(image.getpalette()).reshape(-1, 3)
        # The background is the commonest colour; the mean of it and its neighbours is not quite white.
        colours[np.bincount(np.asarray(image).ravel()).argmax()] = 255
        image.putpalette(colours.ravel().tolist())
    write_whole(path, lambda file: image.save(file, "png", dpi=(dpi, dpi)))


def _view(data: ReportData, index: int, camera: Camera, stills: Stills) -> Figure:
    view, norm, quantity = data.views[index], LogNorm(*deviation_range(data)), data.quantity
    choice, figure = view.choice, Figure(figsize=(8.4, 4.3))
    draw_scene(figure.add_axes((0.0, 0.16, 0.5, 0.78)), data, index, stills[index], camera)
    figure.text(0.015, 0.955, f"View {view.number}", fontsize=11, fontweight="bold", va="center")
    flow(figure, _POINTS, 0.125, 0.955, 0.37, 0.045, 8.0)
    _deviation_bar(figure, (0.08, 0.115, 0.34, 0.022), norm)
    title = "This view was given" if choice is None else f"Why view {view.number}: {quantity.name}"
    fitted(figure, 0.52, 0.955, title, 0.47, 10.0, va="center")
    if choice is None:
        draw_acquisition(figure.add_axes((0.52, 0.22, 0.46, 0.66)), None, quantity)
        return figure
    marks = [
        ("★ chosen", NEW, True),
        ("◯ level with it", INK, choice.rings_tied),
        ("○ start, ● end of an ascent", INK, choice.ascents is not None),
        ("(directions of the cameras; map: cameras that look at the centre)", GREY, view.spatial_ascents is not None),
    ]
    flow(figure, [(text, colour) for text, colour, there in marks if there], 0.52, 0.905, 0.47, 0.04, 8.0)
    colours = draw_acquisition(figure.add_axes((0.54, 0.35, 0.42, 0.5)), choice, quantity)
    draw_candidates(figure.add_axes((0.58, 0.15, 0.34, 0.17)), choice)
    assert colours is not None
    bar = figure.colorbar(colours, cax=figure.add_axes((0.58, 0.115, 0.34, 0.022)), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(5)
    bar.formatter = FuncFormatter(lambda value, _: number(value))
    label = label_of(quantity) if choice.errors is None else f"{label_of(quantity)}; lines: standard errors"
    fitted(figure, 0.75, 0.02, label, 0.46, 9.0, ha="center", va="center")
    return figure


def _deviation_bar(figure: Figure, place: tuple[float, float, float, float], norm: LogNorm, size: float = 9.0) -> None:
    bar = figure.colorbar(ScalarMappable(norm, DEVIATION), cax=figure.add_axes(place), orientation="horizontal")
    bar.outline.set_visible(False)
    # The longest number has some six letters, which are less than two thirds as wide as high.
    gap = 4.2 * size / 72.0 / (place[2] * figure.get_figwidth())
    bar.set_ticks(spaced_ticks(*bar.ax.get_xlim(), gap).tolist())
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.tick_params(labelsize=size)
    # Under the numbers, which are as high as their letters and stand off the bar by half as much.
    below = place[1] - 2.6 * size / 72.0 / figure.get_figheight()
    label = fitted(figure, 0.5, below, DEVIATION_LABEL, min(1.9 * place[2], 0.96), size, ha="center", va="center")
    half, middle = 0.5 * width_of(label, figure), place[0] + 0.5 * place[2]
    label.set_position((max(middle, half + 0.01), below))


def draw_candidates(axes: Axes, choice: Choice) -> None:
    """Draw the values of the open candidates, the best on top, with their standard errors, over a colour bar of the
    same range."""
    order = np.argsort(-choice.values)[: len(choice.open_values)]
    values, rows = choice.values[order], -np.arange(len(order))
    if choice.errors is not None:
        axes.hlines(rows, values - choice.errors[order], values + choice.errors[order], color=GREY, lw=0.6, zorder=1)
    axes.scatter(values, rows, s=4, color=INK, linewidths=0, zorder=2)
    axes.plot(choice.value, 1.0, "*", color=NEW, ms=8, markeredgecolor="white", zorder=3, clip_on=False)
    axes.set(xlim=choice.range, ylim=(-len(order), 3.0 + 0.05 * len(order)))
    axes.axis("off")


def draw_acquisition(
    axes: Axes, choice: Choice | None, quantity: Quantity, weight: float = 1.0
) -> ScalarMappable | None:
    """Draw the candidates' values as a map of the sphere; returns what a colour bar needs, None for a given view."""
    axes.set(xlim=(-2.95, 2.95), ylim=(-1.6, 1.6), aspect="equal")
    axes.axis("off")
    for line in sphere.graticule():
        axes.plot(*line.T, color=LINE, lw=0.5 * weight, alpha=0.6)
    rim = Ellipse((0.0, 0.0), 2 * sphere.WIDTH, 2 * sphere.HEIGHT, fill=False, color=GREY, lw=0.8 * weight, zorder=2)
    axes.add_patch(rim)
    if choice is None:
        axes.text(0.0, 0.0, "given", ha="center", va="center", color=GREY, fontsize=11 * weight)
        return None
    colours = ScalarMappable(Normalize(*choice.range), VALUE)
    if choice.makes_a_map(quantity):
        extent = (-sphere.WIDTH, sphere.WIDTH, -sphere.HEIGHT, sphere.HEIGHT)
        smooth = sphere.smooth_map(choice.map.directions, choice.map.values)
        image = axes.imshow(colours.to_rgba(smooth), extent=extent, interpolation="bilinear", zorder=1)
        image.set_clip_path(rim)
    places = sphere.mollweide(choice.directions)
    shown = ~choice.visited
    dots: dict[str, Any] = {"s": 14 * weight, "edgecolors": GREY, "linewidths": 0.6 * weight}
    axes.scatter(places[shown, 0], places[shown, 1], c=colours.to_rgba(choice.values[shown]), **dots, zorder=3)
    if choice.tied is not None and choice.rings_tied:
        x, y = places[choice.tied & shown].T
        axes.scatter(x, y, s=52 * weight, facecolors="none", edgecolors=INK, linewidths=1.0 * weight, zorder=4)
    cross: dict[str, Any] = {"marker": "x", "c": INK, "s": 26 * weight, "linewidths": 1.2 * weight}
    axes.scatter(places[~shown, 0], places[~shown, 1], **cross, zorder=4)
    if choice.ascents is not None:
        draw_ascents(axes, choice.ascents, weight)
    size = 14 if choice.ascents is None else 11
    star: dict[str, Any] = {"ms": size * weight**0.5, "color": NEW, "markeredgecolor": "white", "mew": 1.0}
    axes.plot(*sphere.mollweide(choice.chosen[None]).T, "*", **star, zorder=10)
    return colours


def overview_figure(data: ReportData, camera: Camera, stills: Stills | None = None) -> Figure:
    """Scenes over acquisition maps, at most five to a row, with the charts' story in the titles."""
    stills = Stills(data) if stills is None else stills
    columns = min(len(data.views), 5)
    rows = -(-len(data.views) // columns)
    marks = [*_POINTS, ("★ chosen view", NEW), ("× visited views", INK)]
    choices = [view.choice for view in data.views if view.choice is not None]
    if any(choice.rings_tied for choice in choices):
        marks.append(("◯ level with the best", INK))
    if any(choice.ascents is not None for choice in choices):
        marks += [("○ start of an ascent", INK), ("● end of an ascent", INK)]
    width = max(3.0 * columns, 6.0)
    # Beside the bar there is room for the words only in a wide strip.
    beside = width > 8.0
    rows_of_marks = -(-len(marks) // 2)
    base = max(1.0, 0.5 + 0.26 * rows_of_marks) if beside else 1.35 + 0.26 * rows_of_marks
    tall = _ROW * rows + base
    figure, left = Figure(figsize=(width, tall)), (width - 3.0 * columns) / 2.0

    def place(x: float, y: float, w: float = 0.0, h: float = 0.0) -> tuple[float, float, float, float]:
        return x / width, y / tall, w / width, h / tall

    for index, view in enumerate(data.views):
        row, column = divmod(index, columns)
        x, y = left + 3.0 * column, tall - _ROW * (row + 1)
        draw_scene(figure.add_axes(place(x, y + 1.55, 3.0, 3.0)), data, index, stills[index], camera, weight=1.3)
        figure.text(*place(x + 0.12, y + 4.85)[:2], f"View {view.number}", fontsize=15, fontweight="bold", va="center")
        seen = f"{view.seen.amount}{' seen' * view.seen.is_share}"
        figure.text(*place(x + 2.88, y + 4.85)[:2], seen, fontsize=14, ha="right", va="center")
        draw_acquisition(figure.add_axes(place(x + 0.1, y, 2.8, 1.5)), view.choice, data.quantity, weight=1.2)
    long = 0.5 * width - 1.2 if beside else width - 1.6
    _deviation_bar(figure, place(0.6, base - 0.35, long, 0.13), LogNorm(*deviation_range(data)), 12.0)
    x, y, room = (0.5 * width + 0.1, base - 0.25, 0.5 * width - 0.3) if beside else (0.3, base - 1.1, width - 0.6)
    text = f"Maps: {data.quantity.name}; dark is high"
    fitted(figure, *place(x, y)[:2], text, room / width, 13.0, va="center")
    flow(figure, marks, *place(x, y - 0.28)[:2], room / width, 0.26 / tall, 12.0)
    return figure
