"""The pictures of an episode as PNG files, for papers and READMEs."""

from pathlib import Path

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
from tqdm.auto import tqdm

from jaxnbv.camera import Camera
from jaxnbv.viz import sphere
from jaxnbv.viz.data import COVERAGE_RADIUS, Choice, ReportData, ViewData
from jaxnbv.viz.render import draw_scene
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, INK, LINE, NEW, VALUE, log_ticks, round_range
from jaxnbv.viz.words import Quantity, number

STYLE = {
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
DEVIATION_LABEL = "standard deviation of the surface (scene units)"


def deviation_range(data: ReportData) -> tuple[float, float]:
    """One range of standard deviations for all views, in round numbers: it leaves out a fiftieth at either end."""
    all_views = [view.surface.deviation for view in data.views if view.surface is not None]
    if not all_views:
        return 1e-3, 1.0
    return round_range(*np.percentile(np.concatenate(all_views), [2.0, 98.0]).tolist())


def write_figures(data: ReportData, camera: Camera, folder: str | Path, progress: bool = True) -> list[Path]:
    """Write the figures of an episode as PNG files into a folder, and return their paths:

    `view_01.png`, ...: scene and acquisition of each view; `coverage.png`: the charts; `overview.png`: all views in a
    strip.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = [*(f"view_{view.number:02d}.png" for view in data.views), "coverage.png", "overview.png"]
    paths = [folder / name for name in names]
    norm = LogNorm(*deviation_range(data))
    with mpl.rc_context(STYLE):
        for path in tqdm(paths, desc="drawing figures", disable=not progress):
            if path.name == "overview.png":
                _save(_overview(data, camera, norm), path, dpi=120)
            elif path.name == "coverage.png":
                _save(_charts(data), path, dpi=200)
            else:
                _save(_view(data, paths.index(path), camera, norm), path, dpi=200)
    return paths


def _save(figure: Figure, path: Path, dpi: int) -> None:
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    # A palette of 256 colours is a third of the size and not to be told apart.
    image.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(path, optimize=True, dpi=(dpi, dpi))


def _view(data: ReportData, index: int, camera: Camera, norm: LogNorm) -> Figure:
    view = data.views[index]
    figure = Figure(figsize=(8.4, 4.3))
    scene = figure.add_axes((0.0, 0.1, 0.5, 0.84))
    draw_scene(scene, view, [other.pose for other in data.views[: index + 1]], camera, norm, 800)
    figure.text(0.015, 0.95, f"View {view.number}", fontsize=11, fontweight="bold")
    _deviation_bar(figure, (0.08, 0.115, 0.34, 0.022), norm)
    _legend(figure, 0.125, 0.955)
    figure.text(0.52, 0.95, _map_title(view, data.quantity), fontsize=10)
    axes = figure.add_axes((0.52, 0.22, 0.46, 0.66))
    colours = draw_acquisition(axes, view.choice, data.quantity)
    if colours is not None:
        bar = figure.colorbar(colours, cax=figure.add_axes((0.58, 0.115, 0.34, 0.022)), orientation="horizontal")
        bar.outline.set_visible(False)
        bar.set_label(data.quantity.label)
    return figure


def _map_title(view: ViewData, quantity: Quantity) -> str:
    return "This view was given" if view.choice is None else f"Why view {view.number}: {quantity.name}"


def _deviation_bar(figure: Figure, place: tuple[float, float, float, float], norm: LogNorm) -> None:
    bar = figure.colorbar(ScalarMappable(norm, DEVIATION), cax=figure.add_axes(place), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_ticks(log_ticks(norm.vmin, norm.vmax).tolist())
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.set_label(DEVIATION_LABEL)


def _legend(figure: Figure, x: float, y: float) -> None:
    figure.text(x, y, "● points before", color=BEFORE, fontsize=8)
    figure.text(x + 0.125, y, "● new points and camera", color=NEW, fontsize=8)


def draw_acquisition(axes: Axes, choice: Choice | None, quantity: Quantity, weight: float = 1.0) -> ScalarMappable | None:
    """Draw the values of the candidates as a map of the sphere; returns what a colour bar needs, None for a given view."""
    axes.set(xlim=(-2.95, 2.95), ylim=(-1.6, 1.6), aspect="equal")
    axes.axis("off")
    colours = None
    if choice is not None:
        colours = ScalarMappable(Normalize(*value_range(choice)), VALUE)
        if quantity.smooth:
            extent = (-sphere.WIDTH, sphere.WIDTH, -sphere.HEIGHT, sphere.HEIGHT)
            smooth = sphere.smooth_map(choice.directions, choice.values, 240)
            image = axes.imshow(colours.to_rgba(smooth), extent=extent, interpolation="bilinear", zorder=1)
            axes.fill(*sphere.rim().T, facecolor="none")
            image.set_clip_path(axes.patches[-1])
    for line in sphere.graticule():
        axes.plot(*line.T, color="white" if choice is not None and quantity.smooth else LINE, lw=0.5 * weight, alpha=0.5)
    axes.plot(*sphere.rim().T, color=GREY, lw=0.8 * weight)
    if choice is None:
        axes.text(0.0, 0.0, "given", ha="center", va="center", color=GREY, fontsize=11 * weight)
        return None
    places = sphere.mollweide(choice.directions)
    shown = ~choice.visited
    axes.scatter(
        *places[shown].T,
        c=colours.to_rgba(choice.values[shown]) if colours else None,
        s=14 * weight,
        edgecolors="white",
        linewidths=0.5 * weight,
        zorder=3,
    )
    axes.scatter(*places[~shown].T, marker="x", c=INK, s=26 * weight, linewidths=1.2 * weight, zorder=4)
    star = {"marker": "*", "s": 190 * weight, "c": NEW, "edgecolors": "white", "linewidths": 0.9 * weight}
    axes.scatter(*sphere.mollweide(choice.chosen[None]).T, **star, zorder=5)
    return colours


def value_range(choice: Choice) -> tuple[float, float]:
    """Range of the colours of a step's values; not empty."""
    values = choice.open_values
    if not values.size:
        return 0.0, 1.0
    low, high = float(values[-1]), float(values[0])
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def coverage_series(data: ReportData) -> tuple[str, Float[np.ndarray, " v"]]:
    """The chart of progress: coverage in percent, or where the truth is not known the points that are kept."""
    shares = [view.coverage for view in data.views]
    if any(share is None for share in shares):
        return "points kept", np.array([float(view.count) for view in data.views])
    return f"coverage (% within {COVERAGE_RADIUS:g})", np.array([100.0 * share for share in shares if share is not None])


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
            axes.annotate("given", (view.number, 0), (0, 4), textcoords="offset points", ha="center", color=GREY, fontsize=8)
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


def _overview(data: ReportData, camera: Camera, norm: LogNorm) -> Figure:
    """Scenes over acquisition maps, at most five to a row, with the charts' story in the titles."""
    columns = min(len(data.views), 5)
    rows = -(-len(data.views) // columns)
    width, tall = 3.0 * columns, 4.75 * rows + 0.75
    figure = Figure(figsize=(max(width, 6.0), tall))
    left = (max(width, 6.0) - width) / 2.0
    poses = [view.pose for view in data.views]

    def place(x, y, w, h):
        return (left + x) / figure.get_figwidth(), y / tall, w / figure.get_figwidth(), h / tall

    for index, view in enumerate(data.views):
        row, column = divmod(index, columns)
        x, y = 3.0 * column, tall - 4.75 * (row + 1)
        scene = figure.add_axes(place(x, y + 1.55, 3.0, 3.0))
        draw_scene(scene, view, poses[: index + 1], camera, norm, 420, weight=1.3)
        share = f"{view.count:,} points" if view.coverage is None else f"{view.coverage:.0%} covered"
        title = place(x + 0.12, y + 4.5, 0, 0)
        figure.text(*title[:2], f"View {view.number}", fontsize=15, fontweight="bold", va="center")
        edge = place(x + 2.88, y + 4.5, 0, 0)
        figure.text(*edge[:2], share, fontsize=14, ha="right", va="center")
        draw_acquisition(figure.add_axes(place(x + 0.1, y, 2.8, 1.5)), view.choice, data.quantity, weight=1.2)
    with mpl.rc_context({"font.size": 12}):
        half = 0.5 * max(width, 6.0)
        _deviation_bar(figure, (0.04, 0.55 / tall, 0.4 * half / half * 0.9, 0.12 / tall), norm)
    return figure
