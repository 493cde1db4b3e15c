"""The pictures of an episode as PNG files, for papers and READMEs."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator
from PIL import Image
from tqdm import tqdm

from jaxnbv.answers import Quantity, number
from jaxnbv.camera import Camera
from jaxnbv.files import make_folder, write_whole
from jaxnbv.viz import sphere
from jaxnbv.viz.data import COVERAGE_RADIUS, Choice, ReportData, ViewData
from jaxnbv.viz.render import draw_scene
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, INK, LINE, NEW, VALUE, log_ticks, round_range
from jaxnbv.viz.trajectory_figures import draw_ascents, trajectory_figure
from jaxnbv.viz.words import percent

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
DEVIATION_LABEL = "standard deviation of the surface (scene units)"


def deviation_range(data: ReportData) -> tuple[float, float]:
    """One range of standard deviations for all views, in round numbers: it leaves out a fiftieth at either end."""
    all_views = [view.surface.deviation for view in data.views if view.surface is not None]
    if not all_views:
        return 1e-3, 1.0
    return round_range(*np.percentile(np.concatenate(all_views), [2.0, 98.0]).tolist())


def write_figures(data: ReportData, camera: Camera, folder: str | Path, progress: bool = True) -> list[Path]:
    """Write the figures of an episode as PNG files into a folder, and return their paths:

    `view_01.png`, ...: scene and acquisition of each view; `view_02_trajectories.png`, ...: the ascents of a gradient
    search in space, of views that were found among 6-DOF poses; `coverage.png`: the charts; `overview.png`: all views
    in a strip.
    """
    folder = make_folder(folder)
    norm = LogNorm(*deviation_range(data))
    drawings: dict[str, Callable[[], Figure]] = {}
    for index, view in enumerate(data.views):
        drawings[f"view_{view.number:02d}.png"] = partial(_view, data, index, camera, norm)
        if view.spatial_ascents is not None:
            drawings[f"view_{view.number:02d}_trajectories.png"] = partial(trajectory_figure, data, index, camera)
    drawings["coverage.png"] = partial(_charts, data)
    drawings["overview.png"] = partial(overview_figure, data, camera)
    with mpl.rc_context(STYLE):
        for name, draw in tqdm(drawings.items(), desc="drawing figures", disable=not progress):
            small = name == "overview.png"
            _save(draw(), folder / name, dpi=120 if small else 200, few_colours=small)
    return [folder / name for name in drawings]


def _save(figure: Figure, path: Path, dpi: int, few_colours: bool = False) -> None:
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    if few_colours:
        # A third of the size; dithered, so that the colour bars stay smooth.
        image = image.quantize(palette=image.quantize(256), dither=Image.Dither.FLOYDSTEINBERG)
        colours = np.asarray(image.getpalette()).reshape(-1, 3)
        # The background is the commonest colour; the mean of it and its neighbours is not quite white.
        colours[np.bincount(np.asarray(image).ravel()).argmax()] = 255
        image.putpalette(colours.ravel().tolist())
    write_whole(path, lambda file: image.save(file, "png", optimize=True, dpi=(dpi, dpi)))


def _view(data: ReportData, index: int, camera: Camera, norm: LogNorm) -> Figure:
    view = data.views[index]
    figure = Figure(figsize=(8.4, 4.3))
    scene = figure.add_axes((0.0, 0.1, 0.5, 0.84))
    draw_scene(scene, view, [other.pose for other in data.views[: index + 1]], camera, norm, 800)
    figure.text(0.015, 0.95, f"View {view.number}", fontsize=11, fontweight="bold")
    _deviation_bar(figure, (0.08, 0.115, 0.34, 0.022), norm)
    _legend(figure, 0.125, 0.955)
    figure.text(0.52, 0.95, _map_title(view, data.quantity), fontsize=10)
    if view.choice is not None and view.choice.ascents is not None:
        _ascent_key(figure, view.spatial_ascents is not None)
    axes = figure.add_axes((0.52, 0.22, 0.46, 0.66))
    colours = draw_acquisition(axes, view.choice, data.quantity)
    if colours is not None:
        bar = figure.colorbar(colours, cax=figure.add_axes((0.58, 0.115, 0.34, 0.022)), orientation="horizontal")
        bar.outline.set_visible(False)
        bar.set_label(data.quantity.label)
    return figure


def _map_title(view: ViewData, quantity: Quantity) -> str:
    return "This view was given" if view.choice is None else f"Why view {view.number}: {quantity.name}"


def _ascent_key(figure: Figure, is_spatial: bool) -> None:
    figure.text(0.52, 0.905, "○ start   ● end of a gradient ascent", fontsize=8)
    figure.text(0.775, 0.905, "★ chosen view", color=NEW, fontsize=8)
    if is_spatial:
        figure.text(0.52, 0.865, "ascents: camera directions; map: cameras that look at the centre", fontsize=8)


def _deviation_bar(figure: Figure, place: tuple[float, float, float, float], norm: LogNorm) -> None:
    bar = figure.colorbar(ScalarMappable(norm, DEVIATION), cax=figure.add_axes(place), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_ticks(log_ticks(*bar.ax.get_xlim()).tolist())
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.set_label(DEVIATION_LABEL)


def _legend(figure: Figure, x: float, y: float) -> None:
    figure.text(x, y, "● points before", color=BEFORE, fontsize=8)
    figure.text(x + 0.125, y, "● new points and camera", color=NEW, fontsize=8)


def draw_acquisition(
    axes: Axes, choice: Choice | None, quantity: Quantity, weight: float = 1.0
) -> ScalarMappable | None:
    """Draw the candidates' values as a map of the sphere; returns what a colour bar needs, None for a given view."""
    axes.set(xlim=(-2.95, 2.95), ylim=(-1.6, 1.6), aspect="equal")
    axes.axis("off")
    for line in sphere.graticule():
        axes.plot(*line.T, color=LINE, lw=0.5 * weight, alpha=0.6)
    axes.plot(*sphere.rim().T, color=GREY, lw=0.8 * weight)
    if choice is None:
        axes.text(0.0, 0.0, "given", ha="center", va="center", color=GREY, fontsize=11 * weight)
        return None
    colours = ScalarMappable(Normalize(*value_range(choice)), VALUE)
    if is_smooth(choice, quantity):
        extent = (-sphere.WIDTH, sphere.WIDTH, -sphere.HEIGHT, sphere.HEIGHT)
        smooth = sphere.smooth_map(choice.map.directions, choice.map.values, 240)
        image = axes.imshow(colours.to_rgba(smooth), extent=extent, interpolation="bilinear", zorder=1)
        image.set_clip_path(axes.fill(*sphere.rim().T, facecolor="none")[0])
    places = sphere.mollweide(choice.directions)
    shown = ~choice.visited
    axes.scatter(
        places[shown, 0],
        places[shown, 1],
        c=colours.to_rgba(choice.values[shown]),
        s=14 * weight,
        edgecolors=GREY,
        linewidths=0.6 * weight,
        zorder=3,
    )
    axes.scatter(
        places[~shown, 0], places[~shown, 1], marker="x", c=INK, s=26 * weight, linewidths=1.2 * weight, zorder=4
    )
    if choice.ascents is not None:
        draw_ascents(axes, choice.ascents, weight)
    size = 14 if choice.ascents is None else 11
    star: dict[str, Any] = {
        "marker": "*",
        "ms": size * weight**0.5,
        "color": NEW,
        "markeredgecolor": "white",
        "mew": 1.0,
    }
    axes.plot(*sphere.mollweide(choice.chosen[None]).T, **star, zorder=10)
    return colours


def is_smooth(choice: Choice, quantity: Quantity) -> bool:
    """Whether a map between the candidates says something: they must be many, and their values no lots."""
    return quantity.smooth and int(np.sum(~np.isnan(choice.map.values))) >= 12


def value_range(choice: Choice) -> tuple[float, float]:
    """Range of the colours of a step's map and candidates; not empty."""
    values = np.concatenate([choice.open_values, choice.map.values[~np.isnan(choice.map.values)]])
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def coverage_series(data: ReportData) -> tuple[str, Float[np.ndarray, " v"]]:
    """The chart of progress: coverage in percent, or where the truth is not known the points that are kept."""
    shares = [view.coverage for view in data.views]
    if any(share is None for share in shares):
        return "points kept", np.array([float(view.count) for view in data.views])
    values = np.array([100.0 * share for share in shares if share is not None])
    return f"coverage (% within {COVERAGE_RADIUS:g})", values


def draw_coverage(axes: Axes, data: ReportData) -> None:
    """Draw progress by view."""
    label, values = coverage_series(data)
    views = np.arange(1, len(values) + 1)
    axes.plot(views, values, color=BEFORE, lw=1.4, marker="o", ms=5, markeredgecolor="white")
    for view, value in zip(views, values, strict=True):
        text = number(value) if label == "points kept" else f"{value:.0f}"
        axes.annotate(text, (view, value), (0, 6), textcoords="offset points", ha="center", fontsize=8)
    axes.set(xlabel="view", ylabel=label, ylim=(0, 1.15 * max(float(values.max()), 1.0)), xlim=(0.6, len(values) + 0.4))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def draw_values(axes: Axes, data: ReportData) -> None:
    """Draw the value of each chosen view over that of the median candidate."""
    for view in data.views:
        if view.choice is None:
            below: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "color": GREY, "fontsize": 8}
            axes.annotate("given", (view.number, 0), (0, 4), **below)
            continue
        axes.vlines(view.number, 0.0, view.choice.value, color=LINE, lw=1.5, zorder=1)
        axes.plot(view.number, view.choice.value, "*", color=NEW, ms=11, markeredgecolor="white", zorder=3)
        if view.choice.open_values.size:
            axes.plot(view.number, np.median(view.choice.open_values), "_", color=INK, ms=11, mew=1.4, zorder=2)
    axes.plot([], [], "*", color=NEW, ms=9, label="chosen view")
    axes.plot([], [], "_", color=INK, ms=9, mew=1.4, label="median candidate")
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    axes.set(xlabel="view", ylabel=data.quantity.label, xlim=(0.6, len(data.views) + 0.4))
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.0), high * 1.12)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _charts(data: ReportData) -> Figure:
    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_coverage(left, data)
    draw_values(right, data)
    return figure


def overview_figure(data: ReportData, camera: Camera) -> Figure:
    """Scenes over acquisition maps, at most five to a row, with the charts' story in the titles."""
    norm = LogNorm(*deviation_range(data))
    columns = min(len(data.views), 5)
    rows = -(-len(data.views) // columns)
    marks = [
        ("●", BEFORE, "points before"),
        ("●", NEW, "new points, camera"),
        ("★", NEW, "chosen view"),
        ("×", INK, "visited views"),
    ]
    if any(view.choice is not None and view.choice.ascents is not None for view in data.views):
        marks += [("○", INK, "start of an ascent"), ("●", INK, "end of an ascent")]
    base = 0.16 * len(marks) - 0.2
    width, tall = 3.0 * columns, _ROW * rows + base + 0.41
    figure = Figure(figsize=(max(width, 6.0), tall))
    left = (max(width, 6.0) - width) / 2.0
    poses = [view.pose for view in data.views]

    def place(x: float, y: float, w: float = 0.0, h: float = 0.0) -> tuple[float, float, float, float]:
        return (left + x) / figure.get_figwidth(), y / tall, w / figure.get_figwidth(), h / tall

    for index, view in enumerate(data.views):
        row, column = divmod(index, columns)
        x, y = 3.0 * column, tall - _ROW * (row + 1)
        scene = figure.add_axes(place(x, y + 1.55, 3.0, 3.0))
        draw_scene(scene, view, poses[: index + 1], camera, norm, 420, weight=1.3)
        share = f"{view.count:,} points" if view.coverage is None else f"{percent(view.coverage)} covered"
        title = place(x + 0.12, y + 4.85)
        figure.text(*title[:2], f"View {view.number}", fontsize=15, fontweight="bold", va="center")
        edge = place(x + 2.88, y + 4.85)
        figure.text(*edge[:2], share, fontsize=14, ha="right", va="center")
        draw_acquisition(figure.add_axes(place(x + 0.1, y, 2.8, 1.5)), view.choice, data.quantity, weight=1.2)
    half = max(width, 6.0) / 2.0
    with mpl.rc_context({"font.size": 12}):
        _deviation_bar(figure, place(0.6, base + 0.11, half - 1.6, 0.13), norm)
    x, y, *_ = place(half + 0.1, base + 0.32)
    text = f"Maps: {data.quantity.name}, pale (low) to dark (high)"
    # At 13 points a letter takes a tenth of an inch.
    figure.text(x, y, text, fontsize=min(13.0, 130.0 * (half - 0.2) / len(text)), va="center")
    for i, (mark, colour, text) in enumerate(marks):
        x, y, *_ = place(half + 0.1 + 2.2 * (i % 2), base - 0.32 * (i // 2))
        figure.text(x, y, f"{mark} {text}", color=colour, fontsize=13, va="center")
    return figure
