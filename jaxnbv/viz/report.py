"""The report of an episode: one HTML page that opens offline."""

import base64
import gzip
import io
import json
import math
from datetime import UTC, datetime
from pathlib import Path

import equinox as eqx
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from plotly.offline import get_plotlyjs

from jaxnbv.checks import AnyArray, checked
from jaxnbv.geometry.frame import Frame
from jaxnbv.planning.episode import Episode
from jaxnbv.storage import describe
from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.storage.folders import versions, writing_in
from jaxnbv.viz.answers import capital, kinds_text, label_of, number_text
from jaxnbv.viz.charts import other_charts, task_charts
from jaxnbv.viz.choice import draw_choice, marks
from jaxnbv.viz.data import ReportData, ViewData, report_data
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.html import render
from jaxnbv.viz.imagined import image_tiles
from jaxnbv.viz.placed_shape import PlacedShape
from jaxnbv.viz.render import draw_scene, draw_truth, render_view
from jaxnbv.viz.sketches import Sketches
from jaxnbv.viz.space import figures_in_space
from jaxnbv.viz.style import BEFORE, DEVIATION, DISPUTED, IMAGINED, NEW, OPEN, PART, bar_ticks, gradient

# Sizes in inches: small, so that letters are legible on a phone.
_SCENE, _SCENE_DPI = (5.2, 4.5), 131
_TRUTH, _TRUTH_DPI = (1.8, 1.8), 150
_CHOICE, _CHOICE_DPI = (4.2, 3.5), 185
_QUALITY = 82


@checked
def write_report(
    episode: Episode,
    folder: str | Path,
    truth: Float[AnyArray, "n 3"] | None = None,
    title: str = "object",
    progress: bool = True,
    rival: Episode | None = None,
    sketches: Sketches | None = None,
    question: str | None = None,
) -> Path:
    """Write `report.html` into a folder, replacing an earlier report, and return its path.

    - `truth`: points of the true surface in scene coordinates, for the chart of coverage; by default sampled from the
      scene if possible. Without truth the chart shows the area that the scans have seen.
    - `title`: name of the object.
    - `rival`: an episode of a different search from the same first view, for comparison.
    - `sketches`: sketches of the episode's steps. Missing sketches are made here.
    - `question`: the question in words, such as "What does the truck carry?"; by default that of the task.

    **Raises:** `ValueError` if the folder cannot be written, or another process writes in it.
    """
    path = make_folder(folder) / "report.html"
    data = report_data(episode, truth, progress, rival=rival, sketches=sketches)
    with writing_in(path.parent):
        write_text(path, report_html(data, title, question))
    return path


def report_html(data: ReportData, title: str, question: str | None = None) -> str:
    """Return the report as HTML text: the template filled with data, pictures and plotly's code."""
    with mpl.rc_context(STYLE):
        pictures = [(_scene_picture(data, index), _choice_picture(data, index)) for index in range(len(data.views))]
        charts = [[_chart(*chart) for chart in make_charts(data)] for make_charts in (task_charts, other_charts)]
    return render(
        Path(__file__).with_name("report.html"),
        title=title,
        data=data,
        label=capital(label_of(data.quantity, data.episode.frame)),
        pictures=pictures,
        task_charts=charts[0],
        other_charts=charts[1],
        settings=_settings(data.episode, title),
        units=_world_of(data.episode)[1],
        length=data.episode.frame.unit,
        gradient=gradient(DEVIATION),
        legends=[_legend(view) for view in data.views],
        truth=_truth_picture(data),
        question=data.task.question if question is None else question,
        ticks=_deviation_ticks(data),
        # Plotly's own JSON holds the numbers in packed form.
        space=_zip(f"[{','.join(str(figure.to_json()) for figure in figures_in_space(data))}]"),
        plotly=_zip(get_plotlyjs()),
        data_url=data_url,
        poses=[_matrix(data, index) for index in range(len(data.views))],
        **{function.__name__: function for function in (capital, number_text, kinds_text, image_tiles, marks)},
    )


def data_url(picture: UInt8[np.ndarray, "h w _"]) -> str:
    """Encode an image as a data URL, lossless if its shorter side has fewer than 64 pixels."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="WEBP", quality=_QUALITY, lossless=min(picture.shape[:2]) < 64)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


def _matrix(data: ReportData, index: int) -> str:
    """Return a view's pose as JSON: a matrix from camera (OpenCV's axes) to world."""
    pose = _world_of(data.episode)[0].to_world(data.views[index].pose)
    return json.dumps(np.asarray(pose.to_matrix(), np.float64).round(6).tolist())


def _world_of(episode: Episode) -> tuple[Frame, str]:
    """Return frame and unit for the poses in the report: those of the object's file, or else of the episode."""
    if episode.scene is not None and (world_frame := episode.scene.world_frame) is not None:
        return world_frame, "the units of the object's file"
    return episode.frame, episode.frame.unit


def _deviation_ticks(data: ReportData) -> list[tuple[float, str]]:
    """Return position (percent of the width) and label of each tick of the deviations' colour bar."""
    low, high = data.deviations
    return [(round(100.0 * math.log(tick / low, high / low), 2), f"{tick:g}") for tick in bar_ticks(low, high)]


def _zip(text: str) -> bytes:
    return gzip.compress(text.encode(), mtime=0)


def _legend(view: ViewData) -> dict[str, str]:
    """Return the colours in the picture of a view, keyed by what they show."""
    colours, surface = {}, view.surface
    if isinstance(surface, PlacedShape):
        colours = {"scanned": PART, "imagined": IMAGINED}
        if surface.agreed.min() < 0.5:
            colours["imagined, but others disagree"] = OPEN
        if surface.disputed_space is not None:
            colours["other shapes"] = DISPUTED
    if len(view.before) > 0:
        colours["points before"] = BEFORE
    return colours | {"new points and camera": NEW}


def _scene_picture(data: ReportData, index: int) -> str:
    figure = Figure(figsize=_SCENE, facecolor="none")
    # Leave a margin, so that the frame of the inset is not cut.
    axes = figure.add_axes((0.002, 0.002, 0.996, 0.996))
    draw_scene(axes, data, index, render_view(data, index), weight=1.1, aspect=_SCENE[0] / _SCENE[1])
    return data_url(_pixels(figure, _SCENE_DPI))


def _truth_picture(data: ReportData) -> str | None:
    figure = Figure(figsize=_TRUTH, facecolor="none")
    is_known = draw_truth(figure.add_axes((0.0, 0.0, 1.0, 1.0)), data)
    return data_url(_pixels(figure, _TRUTH_DPI)) if is_known else None


def _choice_picture(data: ReportData, index: int) -> str:
    figure = Figure(figsize=_CHOICE, facecolor="none")
    draw_choice(figure, data.views[index].proposal, data.quantity, data.episode.frame)
    return data_url(_pixels(figure, _CHOICE_DPI))


def _pixels(figure: Figure, dpi: int) -> UInt8[np.ndarray, "h w 4"]:
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def _chart(title: str, figure: Figure) -> tuple[str, bytes, str]:
    """Return a chart's title, its SVG file, and CSS variables that place the mark of the current view."""
    file = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "jaxnbv"}):
        figure.savefig(file, format="svg", metadata={"Date": None}, transparent=True)
    position, (left, right) = figure.axes[0].get_position(), figure.axes[0].get_xlim()
    box = {
        "left": position.x0,
        "wide": position.width / (right - left),
        "top": 1.0 - position.y1,
        "tall": position.height,
    }
    return capital(title), file.getvalue(), "; ".join(f"--{name}: {fraction:.2%}" for name, fraction in box.items())


def _settings(episode: Episode, title: str) -> dict[str, str]:
    return {
        "Object": title,
        "Planner": eqx.tree_pformat(episode.planner, width=110),
        "Sensor noise": "that of a real sensor" if episode.noise is None else eqx.tree_pformat(episode.noise),
        "Seed": ", ".join(str(word) for word in describe(episode.key)["data"]),
        "Ended": episode.stop_reason or "not by a rule",
        "Versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
        "Written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }
