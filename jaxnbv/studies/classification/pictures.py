"""The qualitative figure of a study of classification: what the sensor saw, view by view and method by method."""

import math
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning import scan
from jaxnbv.studies.classification.hits import CUE_PIXELS
from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.engine.tiles import Tiles, first_scenes, frame, save_pictures
from jaxnbv.viz.style import GREY, LINE, NEW

_SHOWN = ("cross-entropy", "farthest", "uncertainty")
_RIGHT = "#00734f"
_BACKGROUND = np.array(mpl.colors.to_rgb("#f3f5f8"))
_PLAIN, _TINTED = np.array([0.68, 0.72, 0.78]), np.array(mpl.colors.to_rgb(NEW))


def write_pictures(
    records: Sequence[Record], study: ClassificationStudy, folder: str | Path, scenes: int = 3, pixels: int = 250
) -> list[Path]:
    """Write `views_<scene>.png` for the first scenes, not picked ones; return the paths.

    A row a method, a column a view: the true surface in the sensor's field of view, tinted where its cue is if
    only a part of the object does, and beneath it the predicted class with its probability once this view is known.
    Rows are cross-entropy, farthest view and uncertainty, those of them that the records hold, else all that they do.

    - `pixels`: along a side of a view.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    present = methods_of(records, study.methods)
    methods = [method for method in _SHOWN if method in present] or present
    chosen = first_scenes(records, scenes)
    return save_pictures(chosen, folder, "views", lambda one: _picture(one, study, methods, pixels))


def _picture(record: Record, study: ClassificationStudy, methods: Sequence[str], pixels: int) -> Figure:
    held = [record["methods"][method] for method in methods]
    runs = [method["runs"][0] for method in held]
    views = len(runs[0]["log_p"])
    taken = [study.poses_of(method)[:views] for method in held]
    scene = study.scene(record["scene"])
    # Four rays a pixel.
    camera = Camera(height=2 * pixels, width=2 * pixels)
    images = [[_image(scene, camera, pose, bool(study.cue)) for pose in poses] for poses in taken]

    # Inches: all methods share the first view, so it stands once, at the middle of the rows.
    tile, gap, below, left, top, margin = 1.25, 0.1, 0.36, 0.12, 0.8, 0.1 + 0.08 * max(map(len, methods))
    wide, tall = left + views * (tile + gap) + margin + 0.1, top + len(methods) * (tile + below)
    names = study.objects.classes
    title = f"Scene {record['scene']}, {record['framing']}: {names[record['label']]}"
    framed = f"Framed: at least {CUE_PIXELS} {study.cue} pixels. " if study.cue else ""
    caption = f"{framed}Beneath: prediction so far."
    tiles = Tiles(wide, tall, title, caption)

    def place(column: int, row: int | float) -> Axes:
        x = left + column * (tile + gap) + (margin if column else 0.0)
        return tiles.place(x, top + row * (tile + below), tile, tile)

    for row, (method, run) in enumerate(zip(methods, runs, strict=True)):
        for column in range(1, views):
            axes = place(column, row)
            _tile(axes, images[row][column], record["label"], run, column, study)
            if row == 0:
                axes.set_title(f"view {column + 1}", fontsize=9, loc="center", pad=4)
        x, down = left + tile + margin - 0.02, top + row * (tile + below) + 0.5 * tile
        tiles.write(x, down, method, fontsize=9, fontweight="bold", ha="right")
    axes = place(0, 0.5 * (len(methods) - 1))
    _tile(axes, images[0][0], record["label"], runs[0], 0, study)
    axes.set_title("view 1, given", fontsize=9, loc="center", pad=4)
    return tiles.figure


def _tile(
    axes: Axes, image: Float[np.ndarray, "h w 3"], label: int, run: dict, view: int, study: ClassificationStudy
) -> None:
    axes.imshow(image, interpolation="antialiased")
    shows = bool(study.cue) and run[f"{study.cue}_pixels"][view] >= CUE_PIXELS
    frame(axes, NEW if shows else LINE, 1.6 if shows else 0.8)
    guess = int(np.argmax(run["log_p"][view]))
    right = guess == label
    text = f"{study.objects.classes[guess]} {np.exp(run['log_p'][view][guess]):.0%}"
    axes.text(
        0.5,
        -0.06,
        f"✓ {text}" if right else text,
        transform=axes.transAxes,
        ha="center",
        va="top",
        fontsize=9,
        color=_RIGHT if right else GREY,
        fontweight="bold" if right else "normal",
    )


def _image(scene: Scene, camera: Camera, pose: Pose, tinted: bool) -> Float[np.ndarray, "h w 3"]:
    """Lit from the sensor; four rays a pixel. Tinted where its cue is."""
    seen = scan(scene.surface, camera, jax.tree.map(jnp.asarray, pose))
    on_cue = np.asarray(scene.task.thing.on_cue(seen.points)) if tinted else np.zeros(len(seen.mask), bool)
    points, normals, hit = (np.asarray(array) for array in (seen.points, seen.normals, seen.mask))
    rays = pose.position - points
    facing = np.where(hit, np.sum(rays * normals, axis=-1) / np.linalg.norm(rays, axis=-1), 0.0)
    colours = np.where(on_cue[:, None], _TINTED, _PLAIN) * (0.4 + 0.65 * facing)[:, None]
    image = np.where(hit[:, None], np.clip(colours, 0.0, 1.0), _BACKGROUND)
    side = math.isqrt(len(hit)) // 2
    return image.reshape(side, 2, side, 2, 3).mean(axis=(1, 3))
