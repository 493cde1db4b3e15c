"""The report of an episode: one HTML page that opens offline, and the same pictures as PNG files."""

import base64
import html
import io
import json
import math
from datetime import UTC, datetime
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from PIL import Image
from plotly.offline import get_plotlyjs

from jaxnbv.answers import Quantity
from jaxnbv.camera import Camera
from jaxnbv.checks import AnyArray, checked
from jaxnbv.episode import Episode
from jaxnbv.files import make_folder, write_text
from jaxnbv.folders import versions, writing_in
from jaxnbv.storage import describe
from jaxnbv.viz import sphere
from jaxnbv.viz.data import COVERAGE_RADIUS, Choice, MeanSurface, ReportData, ViewData, report_data
from jaxnbv.viz.figures import coverage_series, deviation_range, is_smooth, value_range, write_figures
from jaxnbv.viz.render import beside, frustum
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, INK, LINE, NEW, VALUE, VALUE_LINES, colour_scale, log_ticks
from jaxnbv.viz.trajectories import Ascents
from jaxnbv.viz.trajectory_figures import frusta_steps, small_frusta, spatial_range

_FIGURES = "figures"
_MAX_BEFORE, _MAX_NEW = 4000, 2500
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
    with writing_in(path.parent, _FIGURES):
        write_figures(data, episode.planner.camera, path.parent / _FIGURES, progress)
        write_text(path, report_html(episode, data, title))
    return path


def report_html(episode: Episode, data: ReportData, title: str) -> str:
    """The page as text: a template with the data, the header and plotly's own code put in."""
    # "</" would end the script element that holds the data.
    payload = json.dumps(_payload(episode, data), allow_nan=False).replace("</", "<\\/")
    parts = {
        "TITLE": html.escape(title),
        "HEADER": _header(episode, title),
        "QUANTITY": html.escape(data.quantity.label[:1].upper() + data.quantity.label[1:]),
        "MEANING": html.escape(data.quantity.meaning),
        "COVERAGE": html.escape(_coverage_caption(data)),
        "ASCENTS": _ASCENT_CAPTION if any(view.spatial_ascents is not None for view in data.views) else "",
        "COUNT": str(len(data.views)),
        "SENTENCES": "".join(f"<li>{html.escape(view.sentence)}</li>" for view in data.views),
        "PLOTLY": get_plotlyjs(),
        "DATA": payload,
    }
    text = Path(__file__).with_name("template.html").read_text(encoding="utf-8")
    pieces = text.split("@@")
    return "".join(piece if i % 2 == 0 else parts[piece] for i, piece in enumerate(pieces))


def _coverage_caption(data: ReportData) -> str:
    if data.views[0].coverage is None:
        return "Points kept by view; the true surface is not known."
    return f"Share of the true surface within {COVERAGE_RADIUS:g} scene units of the cloud, by view."


def _header(episode: Episode, title: str) -> str:
    planner = episode.planner
    search, model = (describe(module) for module in (planner.search, planner.model))
    settings = {
        "Object": title,
        "Search": _call(search, depth=2),
        "Acquisition": _call(describe(planner.acquisition)),
        "Surface model": _call(model, depth=2),
        "Carved by": _call(describe(planner.carving), depth=1) if planner.carving else "nothing, as in the paper",
        "Posterior samples": f"{planner.num_samples} on a {planner.grid.resolution}³ grid",
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


def _payload(episode: Episode, data: ReportData) -> dict:
    low, high = deviation_range(data)
    ticks = log_ticks(low, high)
    label, series = coverage_series(data)
    camera = episode.planner.camera
    return {
        "views": [_view(view, camera, data.quantity) for view in data.views],
        "reach": 1.12 * max(1.8, *(view.reach for view in data.views)),
        "deviation": {
            "range": [math.log10(low), math.log10(high)],
            "ticks": np.log10(ticks).tolist(),
            "labels": [f"{tick:g}" for tick in ticks.tolist()],
            "colours": colour_scale(DEVIATION),
        },
        "value": {"colours": colour_scale(VALUE), "lines": colour_scale(VALUE_LINES), "label": data.quantity.label},
        "progress": {"label": label, "values": series.tolist()},
        "map": {
            "graticule": [line.round(4).tolist() for line in sphere.graticule()],
            "rim": sphere.rim().round(4).tolist(),
            "width": sphere.WIDTH,
            "height": sphere.HEIGHT,
        },
        "style": {"ink": INK, "grey": GREY, "line": LINE, "before": BEFORE, "new": NEW},
    }


def _view(view: ViewData, camera: Camera, quantity: Quantity) -> dict:
    return {
        "sentence": view.sentence,
        "before": _thinned(view.before, _MAX_BEFORE),
        "new": _thinned(view.new, _MAX_NEW),
        "eye": beside(view.pose).round(4).tolist(),
        "frustum": frustum(view.pose, camera).round(4).tolist(),
        "label": (1.09 * np.asarray(view.pose.position, dtype=np.float64)).round(4).tolist(),
        "surface": None if view.surface is None else _surface(view.surface),
        "choice": None if view.choice is None else _choice(view.choice, quantity),
        "ascents": None if view.spatial_ascents is None else _spatial(view.spatial_ascents, camera),
    }


def _thinned(points: Float[np.ndarray, "n 3"], limit: int) -> list[list[float]]:
    """At most `limit` rows, evenly taken, rounded to what a screen can show."""
    rows = np.linspace(0, len(points) - 1, min(limit, len(points))).astype(int)
    return np.round(points[rows].astype(np.float64), 3).tolist()


def _surface(surface: MeanSurface) -> dict:
    return {
        "vertices": _packed(surface.vertices, np.float32),
        "faces": _packed(surface.faces, np.uint32),
        "deviation": _packed(np.log10(surface.deviation), np.float32),
    }


def _packed(array: np.ndarray, dtype: type) -> str:
    """The bytes of an array, little-endian, as base64."""
    return base64.b64encode(np.ascontiguousarray(array, np.dtype(dtype).newbyteorder("<")).tobytes()).decode()


def _choice(choice: Choice, quantity: Quantity) -> dict:
    low, high = value_range(choice)
    order = np.argsort(-np.where(choice.visited, -np.inf, choice.values), kind="stable")
    ranks = np.empty(len(order), dtype=int)
    ranks[order] = np.arange(1, len(order) + 1)
    return {
        "places": sphere.mollweide(choice.directions).round(4).tolist(),
        "directions": choice.directions.round(3).tolist(),
        "values": [None if math.isnan(value) else value for value in choice.values.tolist()],
        "ranks": ranks.tolist(),
        "chosen": sphere.mollweide(choice.chosen[None]).round(4)[0].tolist(),
        "value": choice.value,
        "median": float(np.median(choice.open_values)) if choice.open_values.size else None,
        "range": [low, high],
        "image": _map_image(choice, low, high) if is_smooth(choice, quantity) else None,
        "ascents": None if choice.ascents is None else _on_map(choice.ascents),
        "caption": _map_caption(choice),
    }


def _map_caption(choice: Choice) -> str:
    """What the marks of a gradient search on the map are; nothing for other searches."""
    parts = []
    if choice.ascents is not None:
        parts.append("Lines: gradient ascents, from a ring where they start to a dot where they end.")
        if choice.ascents.is_spatial:
            parts.append(
                "They change position and rotation; drawn is the direction of the position, over a map of cameras that "
                "look at the centre from the sphere where the ascents start."
            )
    if not np.array_equal(choice.map.directions, choice.directions):
        parts.append(
            "The candidates are too few for a map, or off the sphere: it is drawn from "
            f"{len(choice.map.values)} more views, valued with the same posterior samples."
        )
    return " ".join(parts)


def _on_map(ascents: Ascents) -> dict:
    starts, ends = (sphere.mollweide(ascents.directions[:, step]).round(4).tolist() for step in (0, -1))
    return {
        "ways": [piece.round(4).tolist() for directions in ascents.directions for piece in sphere.path(directions)],
        "starts": starts,
        "ends": ends,
        "values": ascents.values[:, [0, -1]].tolist(),
    }


def _spatial(ascents: Ascents, camera: Camera) -> dict:
    return {
        "positions": np.asarray(ascents.poses.position, dtype=np.float64).round(3).tolist(),
        "values": ascents.values.tolist(),
        "range": list(spatial_range(ascents)),
        "steps": frusta_steps(ascents).tolist(),
        "frusta": [small_frusta(ascents, i, camera).round(3).tolist() for i in range(len(ascents.values))],
    }


def _map_image(choice: Choice, low: float, high: float) -> str:
    """The smooth map as a PNG in a data address, coloured as the candidates are; clear outside the rim."""
    values = sphere.smooth_map(choice.map.directions, choice.map.values, 300)
    colours = VALUE(mpl.colors.Normalize(low, high)(np.nan_to_num(values)), bytes=True)
    colours[..., 3] = np.where(np.isnan(values), 0, 255)
    file = io.BytesIO()
    Image.fromarray(colours).save(file, format="PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
