"""The part study's qualitative figure: the parts that have been found, view by view and method by method."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Array, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from scipy.spatial import cKDTree

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.planning.episode import observe_scene
from jaxnbv.scanning import SensorNoise
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.engine.tiles import Tiles, frame, save_pictures
from jaxnbv.studies.parts.discovery import TARGET, TARGETS, PartDiscoveryStudy, discovery_time
from jaxnbv.viz.render import Still, draw_segments, frustum
from jaxnbv.viz.style import GREY, INK, LINE

_SHOWN = ("discrete", "gradient-2dof", "farthest", "uncertainty")
_FOUND = "#00734f"
# Okabe and Ito's: a category of ShapeNet-part has at most six parts.
_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7")
# Where pictures are taken from, half of what they span; tries for a good place, and their pixels.
_DISTANCE, _REACH = 11.0, 1.62
_TRIES, _TRY_PIXELS = 40, 40
_HIDDEN, _PALE = 0.12, 0.5
# Cameras are drawn nearer than they stand, small, so that the object can be large.
_NEARER, _FRUSTUM_DEPTH = 0.76, 0.24


def write_pictures(
    records: Sequence[Record], study: PartDiscoveryStudy, folder: str | Path, scenes: int = 3, pixels: int = 420
) -> list[Path]:
    """Write `parts_<scene>.png` for the scenes with the most parts, one to a category; return the paths.

    At the left the true object, coloured by part; a row a method, a column a view: the cloud so far, coloured by the
    part that the segmenter says, the points of this view strong and those before pale, over the true shape. Cameras
    are drawn nearer than they stood. Bars are the points of each part, full at N_target = 60. Methods are the discrete
    and the 2-DOF gradient search, farthest view and uncertainty, those of them that the records hold, else all that
    they do.

    - `pixels`: along a side of a picture.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    present = methods_of(records, study.methods)
    methods = [method for method in _SHOWN if method in present] or present
    chosen: dict[str, Record] = {}
    for record in sorted(records, key=lambda record: -len(record["parts"])):
        chosen.setdefault(record["category"], record)
    return save_pictures(
        list(chosen.values())[:scenes], folder, "parts", lambda record: _picture(record, study, methods, pixels)
    )


def _picture(record: Record, study: PartDiscoveryStudy, methods: Sequence[str], pixels: int) -> Figure:
    scene = study.scene(record["scene"])
    asked = study.truth(scene)
    segmenter = study.segmenter_of(scene)
    own = _palette(len(asked))
    point = jnp.zeros((1, 3))
    labels = jax.eval_shape(segmenter, PointCloud(point, point, jnp.zeros(1, bool))).shape[1]
    colours = np.tile(mpl.colors.to_rgb(GREY), (labels, 1))
    colours[asked] = own
    true, ghost = _stills(study, scene, asked, colours, pixels)
    runs = [record["methods"][method] for method in methods]
    seen = [study.seen(scene, run) for run in runs]

    # Inches: all methods share the first view, so it stands once, at the middle of the rows.
    tile, gap, below, left, top, margin, line = 1.5, 0.1, 0.36, 0.12, 0.74, 1.05, 0.2
    corner, size = _extent(true)
    true_wide, true_tall = 2.1 * size / size.max()
    block = true_tall + 0.35 + line * len(record["parts"])
    columns = max(len(run["views"]) for run in runs)
    given = left + 2.1 + 2 * gap
    wide = given + columns * (tile + gap) + margin
    tall = top + max(len(methods) * (tile + below), block)
    caption = (
        "Points: the part that the segmenter says; strong are those of this view. "
        f"Bars: points of each part, full at {TARGET}. Framed: all parts have been found."
    )
    tiles = Tiles(wide, tall, f"Scene {record['scene']}: {scene.name}", caption)
    middle = top + 0.5 * (tall - top - below)

    def column_at(column: int) -> float:
        return given + column * (tile + gap) + (margin if column else 0.0)

    axes = tiles.place(left + 0.5 * (2.1 - true_wide), middle - 0.5 * block + 0.2, true_wide, true_tall)
    axes.imshow(true.image, interpolation="antialiased")
    axes.set(xlim=corner[0] + [0, size[0]], ylim=corner[1] + [size[1], 0])
    axes.axis("off")
    tiles.write(left + 1.05, middle - 0.5 * block + 0.08, "true parts", fontsize=9, ha="center")
    for index, (name, colour) in enumerate(zip(record["parts"], own, strict=True)):
        down = middle + 0.5 * block + line * (index + 0.5 - len(record["parts"]))
        tiles.write(left + 0.6, down, "●", color=colour, fontsize=11)
        tiles.write(left + 0.8, down, name, fontsize=9)

    def draw(axes: Axes, row: int, column: int) -> None:
        shown, evidence = seen[row][column]
        _draw_view(axes, ghost, segmenter.predict(evidence.cloud), shown, colours)
        taken = study.poses_of(runs[row])[: column + 1]
        for index, pose in enumerate(taken):
            _draw_camera(axes, ghost, study.camera, pose, is_new=index == column)
        _finish(axes, ghost.size, runs[row], column, own)

    for row, (method, run) in enumerate(zip(methods, runs, strict=True)):
        down, held = top + row * (tile + below), len(run["views"])
        tiles.write(column_at(1) - gap, down + 0.5 * tile, method, fontsize=9, fontweight="bold", ha="right")
        for column in range(1, held):
            draw(tiles.place(column_at(column), down, tile, tile), row, column)
        if held < columns:
            text = f"every part has\n{max(TARGETS)} points"
            tiles.write(
                column_at(max(held, 1)) + 0.5 * tile, down + 0.5 * tile, text, fontsize=8, color=GREY, ha="center"
            )
    for column in range(1, columns):
        tiles.write(column_at(column) + 0.5 * tile, top - 0.12, f"view {column + 1}", fontsize=9, ha="center")
    draw(tiles.place(given, middle - 0.5 * tile, tile, tile), 0, 0)
    tiles.write(given + 0.5 * tile, middle - 0.5 * tile - 0.12, "view 1, given", fontsize=9, ha="center")
    return tiles.figure


def _palette(count: int) -> Float[np.ndarray, "count 3"]:
    """A colour for each part."""
    if count <= len(_COLOURS):
        return np.array([mpl.colors.to_rgb(colour) for colour in _COLOURS[:count]])
    return mpl.colormaps["turbo"](np.linspace(0.05, 0.95, count))[:, :3]


def _stills(
    study: PartDiscoveryStudy, scene: Scene, asked: Sequence[int], colours: Float[np.ndarray, "labels 3"], size: int
) -> tuple[Still, Still]:
    """The true object coloured by part, and a pale ghost of it: seen from where each part shows nearly as much as from
    where it shows best."""
    places = _places()
    tried = _look(scene, Camera(2.0 * math.atan(1.5 / _DISTANCE), _TRY_PIXELS, _TRY_PIXELS), places)
    labels = _true_parts(study, scene, tried)
    pixels = np.stack([(labels == part).sum(axis=1) for part in asked], axis=1).astype(np.float64)
    share = pixels / np.maximum(pixels.max(axis=0), 1.0)
    # A part that none of these places shows has no say.
    eye = np.asarray(places.position[int(np.argmax(share[:, share.any(axis=0)].min(axis=1)))], np.float64)
    true, ghost = (Still(eye, None, size, _REACH) for _ in range(2))
    seen = _look(scene, true.fine_camera, true.pose)
    mask, points, normals = (np.asarray(leaf) for leaf in (seen.mask, seen.points, seen.normals))
    rays = np.asarray(true.pose.position) - points[mask]
    facing = np.abs(np.sum(rays * normals[mask], axis=-1)) / np.linalg.norm(rays, axis=-1)
    depth = -rays @ np.asarray(true.pose.forward)
    for still, plain, lit in (
        (true, colours[_true_parts(study, scene, seen)[mask]], 0.62 + 0.42 * facing),
        (ghost, np.array(mpl.colors.to_rgb(LINE)), 0.84 + 0.2 * facing),
    ):
        shaded = np.clip(plain * lit[:, None], 0.0, 1.0)
        still.show(mask, np.column_stack([shaded, np.ones(len(shaded))]), depth)
    return true, ghost


def _extent(still: Still) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The first corner and the size of the object's box in the picture."""
    rows, columns = np.nonzero(still.image[..., 3])
    pixels = np.stack([columns, rows])
    low, high = pixels.min(axis=1) - 2.0, pixels.max(axis=1) + 2.0
    return low, high - low


def _draw_view(
    axes: Axes,
    ghost: Still,
    predicted: tuple[PointCloud, Int[Array, " n"]],
    latest: PointCloud,
    colours: Float[np.ndarray, "labels 3"],
) -> None:
    """The cloud so far over the ghost of the true object, which hides nothing but dims what it would hide."""
    fed, labels = predicted
    mask = np.asarray(fed.mask)
    points, own = np.asarray(fed.points)[mask], colours[np.asarray(labels)[mask]]
    # Rows of D are those of the scans, bit by bit.
    is_new = cKDTree(latest.to_numpy()[0]).query(points)[0] == 0.0
    pixels, in_front = ghost.project(points)
    axes.imshow(ghost.image, interpolation="antialiased", zorder=1)
    tinted = np.where(is_new[:, None], own, 1.0 - (1.0 - _PALE) * (1.0 - own))
    rgba = np.concatenate([tinted, np.where(in_front, 1.0, _HIDDEN)[:, None]], axis=1)
    for new, size in ((False, 2.2), (True, 3.6)):
        # The nearest last.
        order = np.flatnonzero(is_new == new)
        order = order[np.argsort((points[order] - np.asarray(ghost.pose.position)) @ np.asarray(ghost.pose.forward))]
        order = order[::-1]
        axes.scatter(pixels[order, 0], pixels[order, 1], s=size, c=rgba[order], linewidths=0, zorder=2 + new)


def _finish(axes: Axes, size: int, run: dict, view: int, colours: Float[np.ndarray, "parts 3"]) -> None:
    """Frame and bars of one tile."""
    axes.set(xlim=(0, size), ylim=(size, 0))
    found = discovery_time(np.asarray(run["counts"]), TARGET)
    is_found = found is not None and found <= view + 1
    frame(axes, _FOUND if is_found else LINE, 1.6 if is_found else 0.8)
    if found == view + 1:
        inside: dict[str, Any] = {"transform": axes.transAxes, "ha": "left", "va": "top"}
        axes.text(0.03, 0.975, "✓ all found", color=_FOUND, fontsize=8, fontweight="bold", **inside, zorder=5)
    counts = run["counts"][view]
    width = 1.0 / len(counts)
    for index, (count, colour) in enumerate(zip(counts, colours, strict=True)):
        full, x = min(count / TARGET, 1.0), (index + 0.08) * width
        for share, fill in ((1.0, LINE), (full, colour)):
            bar = Rectangle((x, -0.085), 0.84 * width * share, 0.04, transform=axes.transAxes, clip_on=False)
            bar.set(facecolor=fill, edgecolor="none")
            axes.add_patch(bar)
        text: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 7, "transform": axes.transAxes}
        axes.text((index + 0.5) * width, -0.1, str(count), color=INK if count >= TARGET else GREY, **text)


def _draw_camera(axes: Axes, still: Still, camera: Camera, pose: Pose, is_new: bool) -> None:
    """A frustum; faint where the object hides it."""
    ends = frustum(Pose(pose.rotation, _NEARER * pose.position), camera, _FRUSTUM_DEPTH)
    colour = mpl.colors.to_rgba(INK if is_new else GREY, 1.0 if is_new else 0.6)
    draw_segments(axes, still, ends, np.tile(colour, (len(ends), 1)), 1.1 if is_new else 0.6)


def _places() -> Pose:
    """Level places to look from, and some a little above and below."""
    places = fibonacci_sphere(_TRIES, _DISTANCE)
    height = np.asarray(places[:, 1]) / _DISTANCE
    return look_at(places[(height > -0.2) & (height < 0.7)])


def _look(scene: Scene, camera: Camera, places: Pose) -> PointCloud:
    """What a camera sees of the true object."""
    return observe_scene(scene.surface, camera, places, SensorNoise(0.0, 0.0), jax.random.key(0))


def _true_parts(study: PartDiscoveryStudy, scene: Scene, seen: PointCloud) -> Int[np.ndarray, "*batch rays"]:
    """The part of each point, -1 where there is none."""
    labels = study.true_parts(scene, seen.points.reshape(-1, 3)).reshape(seen.mask.shape)
    return np.asarray(jnp.where(seen.mask, labels, -1))
