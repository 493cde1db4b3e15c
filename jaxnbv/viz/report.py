"""The report of an episode: one HTML page that opens offline, and the same pictures as PNG files."""

import base64
import gzip
import html
import io
import json
import math
from datetime import UTC, datetime
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from jaxnbv.checks import AnyArray, checked
from jaxnbv.geometry.camera import Camera
from jaxnbv.planning.episode import Episode
from jaxnbv.storage import describe
from jaxnbv.storage.files import make_folder, write_text
from jaxnbv.storage.folders import versions, writing_in
from jaxnbv.viz.answers import Panel, label_of, may_be_words, number
from jaxnbv.viz.data import ReportData, report_data
from jaxnbv.viz.figures import STYLE, Stills, write_figures
from jaxnbv.viz.imagined_figures import Tile, depths, looks
from jaxnbv.viz.page_data import payload, picture_address
from jaxnbv.viz.render import draw_scene, look_picture
from jaxnbv.viz.task_figures import chart_figure, other_charts, task_charts

_FIGURES = "figures"
_SCENE, _SCENE_DPI = (6.8, 5.9), 100
_CHART, _SMALL_CHART = (4.4, 2.6), (3.1, 2.6)
_ASCENT_CAPTION = """
      Small cameras stand along the gradient ascents, pale to dark with their acquisition, thicker towards the end."""


@checked
def write_report(
    episode: Episode,
    folder: str | Path,
    truth: Float[AnyArray, "n 3"] | None = None,
    title: str = "object",
    progress: bool = True,
) -> Path:
    """Write `report.html` and `figures/*.png` into a folder, which is made where it is missing, and return the page's
    path. Files of an earlier report are replaced.

    - `truth`: points of the true surface in scene coordinates, for the chart of coverage; by default sampled from the
      scene, where it can be. Without truth the chart counts points.
    - `title`: what the object is called.

    **Raises:** `ValueError` if the folder cannot be written, or another process writes in it.
    """
    path = make_folder(folder) / "report.html"
    data = report_data(episode, truth, progress)
    stills = Stills(data)
    with writing_in(path.parent, _FIGURES):
        write_figures(data, episode.planner.camera, path.parent / _FIGURES, progress, stills)
        write_text(path, report_html(episode, data, title, stills))
    return path


def report_html(episode: Episode, data: ReportData, title: str, stills: Stills | None = None) -> str:
    """The page as text: a template with the data, the pictures and plotly's own code put in.

    `stills`: painted surfaces, where they are at hand.
    """
    stills, camera = Stills(data) if stills is None else stills, episode.planner.camera
    # "</" would end the script element that holds the data.
    numbers = json.dumps(payload(data, camera), allow_nan=False).replace("</", "<\\/")
    with mpl.rc_context(STYLE):
        scenes = [_scene(data, index, stills, camera) for index in range(len(data.views))]
        own = task_charts(data)
        size = _CHART if len(own) == 1 else _SMALL_CHART
        task = "".join(_chart(chart, size) for chart in own)
        charts = "".join(_chart(chart, _CHART) for chart in other_charts(data))
    parts = {
        "TITLE": html.escape(title),
        "QUESTION": html.escape(data.task.question),
        "ASKED": html.escape(data.task.asked),
        "FOUND": html.escape(data.task.found),
        "SURE": html.escape(data.task.sure),
        "SETTINGS": _settings(episode, title),
        "QUANTITY": html.escape(_capital(label_of(data.quantity))),
        "MEANING": html.escape(data.quantity.meaning),
        "ASCENTS": _ASCENT_CAPTION if any(view.spatial_ascents is not None for view in data.views) else "",
        "COUNT": str(len(data.views)),
        "SCENES": "".join(scenes),
        "TASK": task,
        "CHARTS": charts,
        "TABLES": "".join(_table(panels, title) for title, panels in _panels(data)),
        "IMAGINED": "".join(_imagined(data, index) for index in range(len(data.views))),
        "SENTENCES": "".join(f"<li>{html.escape(view.sentence)}</li>" for view in data.views),
        "PLOTLY": base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode(),
        "DATA": numbers,
    }
    text = Path(__file__).with_name("template.html").read_text(encoding="utf-8")
    pieces = text.split("@@")
    return "".join(piece if i % 2 == 0 else parts[piece] for i, piece in enumerate(pieces))


def _scene(data: ReportData, index: int, stills: Stills, camera: Camera) -> str:
    """The picture of one view's scene, and in its corner what the new view saw."""
    figure = Figure(figsize=_SCENE)
    axes, aspect = figure.add_axes((0, 0, 1, 1)), _SCENE[0] / _SCENE[1]
    across, up = draw_scene(axes, data, index, stills[index], camera, weight=1.2, inset=False, aspect=aspect)
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(_SCENE_DPI)
    canvas.draw()
    view = data.views[index]
    alt = f"The scene after view {view.number}: the mean surface by its uncertainty, points and cameras."
    shown = f'<img src="{picture_address(np.asarray(canvas.buffer_rgba())[..., :3])}" alt="{alt}">'
    if view.look is not None:
        inset = picture_address(look_picture(view.look, plain=True), lossless=True)
        corner = f"{'right' if across else 'left'}:0;{'top' if up else 'bottom'}:0"
        shown += f'<img class="inset" style="{corner}" src="{inset}" alt="What view {view.number} saw.">'
    return f'<div class="of" hidden>{shown}</div>'


def _chart(chart: tuple, size: tuple[float, float]) -> str:
    """A chart as a drawing, and where its views are, so that the page can mark one."""
    title, _ = chart
    figure, file = chart_figure([chart], *size, titled=False), io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "jaxnbv"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    place = figure.axes[0].get_position()
    address = "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode()
    name = html.escape(_capital(title))
    box = ",".join(f"{share:.4f}" for share in (place.x0, place.width, 1.0 - place.y1, place.height))
    return (
        f'<figure class="card"><h2>{name}</h2><div class="chart" data-axes="{box}"><img src="{address}" '
        f'alt="{name}, by view; its numbers are in a table below."><i></i></div></figure>'
    )


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _panels(data: ReportData) -> list[tuple[str, tuple[Panel, ...]]]:
    return [(panels[-1].label, panels) for panels in zip(*data.task.panels, strict=True)]


def _table(panels: tuple[Panel, ...], title: str) -> str:
    """The numbers of a chart of the task."""
    last = panels[-1]
    rows = [(f"view {view}", panel.values) for view, panel in enumerate(panels, start=1)]
    if last.true is not None:
        rows.append(("in truth", last.true))
    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in last.names)
    body = "".join(
        f'<tr><th scope="row">{name}</th>{"".join(f"<td>{number(value)}</td>" for value in values.tolist())}</tr>'
        for name, values in rows
    )
    caption = html.escape(_capital(title))
    head = f"<caption>{caption}</caption><thead><tr><td></td>{head}</tr></thead>"
    return f"<div><table>{head}<tbody>{body}</tbody></table></div>"


def _imagined(data: ReportData, index: int) -> str:
    """What was imagined before a view: its pictures."""
    seen = data.views[index].imagined
    if seen is None:
        why = "View 1 was given" if index == 0 else f"What was imagined before view {index + 1} is not known"
        return f'<div class="of" hidden><p>{why}: nothing was imagined before it.</p></div>'
    tiles, scale = depths(seen)
    may_be = f"<p>{html.escape(may_be_words(seen.kinds))}</p>" if seen.kinds else ""
    return (
        f'<div class="of" hidden>{may_be}<div class="tiles">{_tiles(looks(seen))}</div><h3>Expected | seen</h3>'
        f'<div class="tiles">{_tiles(tiles)}</div><p>{html.escape(scale)}</p></div>'
    )


def _tiles(tiles: list[Tile]) -> str:
    return "".join(
        f'<figure><img src="{picture_address(tile.picture, lossless=min(tile.picture.shape[:2]) < 64)}" '
        f'alt="{html.escape(tile.name)}"><figcaption>{html.escape(tile.name)}</figcaption></figure>'
        for tile in tiles
    )


def _settings(episode: Episode, title: str) -> str:
    planner = episode.planner
    imagination, carving = planner.imagination, planner.imagination.carving
    search, model = (describe(module) for module in (planner.search, planner.imagination.model))
    settings = {
        "Object": title,
        "Search": _call(search, depth=2),
        "Acquisition": _call(describe(planner.acquisition)),
        "Surface model": _call(model, depth=2),
        "Carved by": _call(describe(carving), depth=1) if carving else "nothing, as in the paper",
        "Posterior samples": f"{imagination.num_samples} on a {imagination.grid.resolution}³ grid",
        "Camera": f"{math.degrees(planner.camera.fov):.0f}°, {planner.camera.width} × {planner.camera.height} pixels",
        "Sensor noise": "that of a real sensor" if episode.noise is None else _call(describe(episode.noise)),
        "Capacity": f"{planner.capacity:,} points",
        "Seed": ", ".join(str(word) for word in describe(episode.key)["data"]),
        "Ended": episode.stopped or "after as many views as were asked for",
        "Versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
        "Written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }
    rows = (f"<div><dt>{name}</dt><dd>{html.escape(str(value))}</dd></div>" for name, value in settings.items())
    return "".join(rows)


def _call(description: dict, depth: int = 0) -> str:
    """A module's description as the call that made it; of the modules within, down to a depth, too."""
    arguments = {name: value for name, value in description.items() if name != "type" and value is not None}
    inside = ", ".join(f"{name}={_short(value, depth)}" for name, value in arguments.items())
    return f"{description['type']}({inside})" if inside else str(description["type"])


def _short(value, depth: int) -> str:
    if isinstance(value, list) and any(isinstance(one, dict) for one in value):
        return f"({', '.join(_short(one, depth) for one in value)})"
    if isinstance(value, dict):
        return _call(value, depth - 1) if depth > 0 and "type" in value else value.get("type", "...")
    return f"{value:.4g}" if isinstance(value, float) else str(value)
