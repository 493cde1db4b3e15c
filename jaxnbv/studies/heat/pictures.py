"""The heat study's qualitative figure: the temperature of the clouds, and where they say that it is coldest."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, fibonacci_sphere
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.study import Scene, views_of
from jaxnbv.studies.engine.tiles import Tiles, first_scenes, frame, save_pictures
from jaxnbv.studies.heat.study import HeatStudy, Truth, heat_problem
from jaxnbv.tasks import body_temperature
from jaxnbv.tasks.diffusion import HeatProblem
from jaxnbv.viz.data import MeanSurface
from jaxnbv.viz.render import Still, draw_segments, frustum
from jaxnbv.viz.style import GREY

_SHOWN = ("heat", "heat-reached", "farthest", "uncertainty", "random")
# Without its palest colours, which would not stand out against the grey of what was not scanned.
_HEAT = LinearSegmentedColormap.from_list("heat", mpl.colormaps["inferno"](np.linspace(0.0, 0.9, 256)))
_TRUE, _ESTIMATED, _REACHED, _SOURCE = "#009e73", "#0072b2", "#56b4e9", "#d55e00"
# Half of what a picture spans, places to look from that are tried.
_REACH, _TRIES = 1.6, 80
# A target counts as visible from a place if what is hit in its direction lies this near.
_VISIBLE = 0.05
_ROD = 0.1
# Cameras are drawn nearer than they stand, small, so that the object can be large.
_NEARER, _FRUSTUM_DEPTH = 0.5, 0.24


class _Stage(NamedTuple):
    """Where all pictures of a scene are taken from, and what they share."""

    still: Still
    truth: Truth
    heat: HeatProblem
    norm: Normalize


def write_pictures(
    records: Sequence[Record], study: HeatStudy, folder: str | Path, scenes: int = 4, pixels: int = 420
) -> list[Path]:
    """Write `heat_<scene>.png` for the first scenes, not picked ones; return the paths.

    At the left the object's own temperature; a row a method, a column a number of views: the points of the cloud that
    can be seen, coloured by temperature, over the grey of the object; its coldest point, and the estimates. Cameras
    are drawn nearer than they stood. Methods are the two that seek cold by full search and the baselines, those of
    them that the records hold, else all that they do. Views are scanned again as they were.

    - `pixels`: along a side of a picture.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    present = methods_of(records, study.methods)
    methods = [method for method in _SHOWN if method in present] or present
    chosen = first_scenes(records, scenes)
    return save_pictures(chosen, folder, "heat", lambda record: _picture(record, study, methods, pixels))


def _picture(record: Record, study: HeatStudy, methods: Sequence[str], pixels: int) -> Figure:
    scene = study.scene(record["scene"])
    stage = _stage(study, scene, pixels)
    runs = [record["methods"][method] for method in methods]
    views = views_of(runs[0])
    columns = sorted({math.ceil(views / 3), math.ceil(2 * views / 3), views})

    # Inches.
    tile, gap, below, top, left, margin, big, key = 1.75, 0.1, 0.24, 0.75, 0.12, 1.25, 2.5, 1.95
    given = left + big + margin
    wide = given + len(columns) * (tile + gap)
    tall = top + max(len(methods) * (tile + below), big + key)
    caption = "Scanned points, coloured by the temperature that they give; grey: not scanned.\n"
    caption += "Below each: distance of the estimate to the coldest points."
    tiles = Tiles(wide, tall, f"Scene {record['scene']}: {record['name']}", caption)
    start = top + 0.5 * (tall - top - big - key)
    tiles.write(left + 0.5 * big, start - 0.1, "the object's temperature", fontsize=9, ha="center")
    _draw_truth(tiles.place(left, start, big, big), stage)
    _key(tiles.figure, tiles.place(left + 0.2, start + big + 0.05, big - 0.4, 0.09), stage)
    for row, (method, run) in enumerate(zip(methods, runs, strict=True)):
        down = top + row * (tile + below)
        tiles.write(given - gap, down + 0.5 * tile, method, fontsize=9, fontweight="bold", ha="right")
        clouds = [evidence.cloud for _, evidence in study.seen(scene, run)]
        taken = study.poses_of(run)
        for column, count in enumerate(columns):
            axes = tiles.place(given + column * (tile + gap), down, tile, tile)
            _draw_cloud(axes, stage, clouds[count - 1], taken[:count])
            estimates = {name: {key: of[key][count - 1] for key in of} for name, of in run["estimates"].items()}
            _draw_estimates(axes, stage, estimates)
            if row == 0:
                text = f"after {count} view{'s' if count > 1 else ''}"
                axes.set_title(text, fontsize=9, loc="center", pad=4)
    return tiles.figure


def _stage(study: HeatStudy, scene: Scene, pixels: int) -> _Stage:
    truth, heat = study.truth(scene), heat_problem(scene)
    mesh = truth.mesh
    normals = np.asarray(_vertex_normals(mesh.vertices, mesh.faces))
    surface = MeanSurface(mesh.vertices, mesh.faces, normals, np.ones(len(mesh.vertices)))
    still = Still(_eye(truth, np.asarray(heat.source, np.float64)), surface, pixels, _REACH)
    still.paint(None)
    return _Stage(still, truth, heat, Normalize(0.0, float(truth.temperatures.max())))


def _vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: np.ndarray) -> Float[np.ndarray, "v 3"]:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(across[:, i], 3), len(vertices)) for i in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _eye(truth: Truth, source: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A direction from which the coldest point shows, if there is one the source too, and as a person would stand."""
    eyes = np.asarray(fibonacci_sphere(_TRIES, 1.0), np.float64)
    seen = [_sees(truth, 11.0 * eyes, target) for target in (truth.coldest, source)]
    return eyes[np.argmax(4.0 * seen[0] + 1.0 * seen[1] - np.abs(eyes[:, 1] - 0.35))]


def _sees(truth: Truth, eyes: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "3"]) -> Bool[np.ndarray, " n"]:
    away = target - eyes
    hits = truth.mesh.trace(eyes, away / np.linalg.norm(away, axis=1, keepdims=True))
    return np.asarray(hits.mask) & (np.linalg.norm(np.asarray(hits.points) - target, axis=1) < _VISIBLE)


def _draw_truth(axes: Axes, stage: _Stage) -> None:
    _draw_points(axes, stage, stage.truth.points, stage.truth.temperatures, 2.2)
    _mark(axes, stage, np.asarray(stage.heat.source, np.float64), _SOURCE, "X", 7.0)
    _finish(axes, stage)
    _mark(axes, stage, stage.truth.coldest, _TRUE, "*", 12.0)


def _draw_cloud(axes: Axes, stage: _Stage, cloud: PointCloud, poses: Sequence[Pose]) -> None:
    points, temperature = body_temperature(cloud, stage.heat)
    _draw_points(axes, stage, points, temperature.values, 2.6)
    for number, pose in enumerate(poses, start=1):
        near = Pose(pose.rotation, _NEARER * pose.position)
        ends = frustum(near, Camera(), _FRUSTUM_DEPTH)
        draw_segments(axes, stage.still, ends, mpl.colors.to_rgba_array([GREY] * len(ends)), 0.7)
        (place,), _ = stage.still.project(1.09 * np.asarray(near.position, np.float64)[None])
        axes.text(place[0], place[1], str(number), fontsize=6.5, color=GREY, ha="center", va="center", zorder=4)
    _finish(axes, stage)


def _draw_points(
    axes: Axes, stage: _Stage, points: Float[np.ndarray, "n 3"], temperatures: Float[np.ndarray, " n"], size: float
) -> None:
    """Those that the object does not hide, the nearest last."""
    axes.imshow(stage.still.image, interpolation="antialiased", zorder=1)
    pixels, in_front = stage.still.project(points)
    depth = (points - np.asarray(stage.still.pose.position)) @ np.asarray(stage.still.pose.forward)
    order = np.argsort(-depth)
    order = order[in_front[order]]
    x, y = pixels[order].T
    axes.scatter(x, y, s=size, c=_HEAT(stage.norm(temperatures[order])), linewidths=0, zorder=2)


def _draw_estimates(axes: Axes, stage: _Stage, estimates: dict[str, dict[str, Any]]) -> None:
    """The estimate among the points that the source warms only where it is another one."""
    _mark(axes, stage, stage.truth.coldest, _TRUE, "*", 10.0)
    paper, reached = estimates["all"], estimates["reached"]
    text = f"{paper['distances']:.2f}"
    if paper["points"] != reached["points"]:
        _mark(axes, stage, np.array(reached["points"]), _REACHED, "D", 4.6)
        text += f"   (among warmed {reached['distances']:.2f})"
    _mark(axes, stage, np.array(paper["points"]), _ESTIMATED, "o", 5.8)
    axes.text(0.5, -0.02, text, transform=axes.transAxes, ha="center", va="top", fontsize=8)


def _mark(axes: Axes, stage: _Stage, point: Float[np.ndarray, "3"], colour: str, marker: str, size: float) -> None:
    """Filled if it shows, or lies behind what is no thicker than a rod; hollow if the object hides it."""
    pixels, _ = stage.still.project(point[None])
    _, in_front = stage.still.project((point - _ROD * np.asarray(stage.still.pose.forward))[None])
    fill, edge = (colour, "white") if in_front[0] else ("white", colour)
    axes.plot(pixels[0, 0], pixels[0, 1], marker, ms=size, mew=0.9, mfc=fill, mec=edge, zorder=6)


def _finish(axes: Axes, stage: _Stage) -> None:
    size = stage.still.size
    axes.set(xlim=(0, size), ylim=(size, 0))
    frame(axes)


def _key(figure: Figure, axes: Axes, stage: _Stage) -> None:
    bar = figure.colorbar(ScalarMappable(stage.norm, _HEAT), cax=axes, orientation="horizontal", extend="max")
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=7, length=2)
    bar.set_label("temperature (degrees)", fontsize=8)
    marks = {
        "heat source": (_SOURCE, "X", 7.0),
        "coldest point of the object": (_TRUE, "*", 11.0),
        "coldest point of the cloud": (_ESTIMATED, "o", 6.5),
        "coldest point that the source warms": (_REACHED, "D", 5.0),
    }
    handles: list[Line2D] = [
        Line2D([], [], marker=marker, ls="none", ms=size, color=colour, mec="white", label=name)
        for name, (colour, marker, size) in marks.items()
    ]
    handles.append(Line2D([], [], marker="o", ls="none", ms=6.0, mfc="white", mec=GREY, label="hollow: hidden"))
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -4.4), frameon=False, fontsize=8)
