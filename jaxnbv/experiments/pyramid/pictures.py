"""The pyramid study's qualitative figure: what the sensor saw, view by view and method by method."""

import math
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Array, Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.camera import Camera
from jaxnbv.datasets import PATTERNS, Framing, Pyramid, Split, pyramid_scene
from jaxnbv.experiments.measures import Record, methods_of
from jaxnbv.experiments.pyramid.hits import PATTERN_PIXELS
from jaxnbv.experiments.pyramid.study import PyramidStudy
from jaxnbv.experiments.tiles import Tiles, first_scenes, frame, save_pictures
from jaxnbv.pose import Pose
from jaxnbv.scanning import SDFSurface, scan
from jaxnbv.viz.style import GREY, LINE, NEW

_SHOWN = ("cross-entropy", "farthest", "uncertainty")
_RIGHT = "#00734f"
_BACKGROUND = np.array(mpl.colors.to_rgb("#f3f5f8"))
_PLAIN, _TINTED = np.array([0.68, 0.72, 0.78]), np.array(mpl.colors.to_rgb(NEW))


def write_pictures(
    records: Sequence[Record], study: PyramidStudy, folder: str | Path, scenes: int = 3, pixels: int = 250
) -> list[Path]:
    """Write `views_<scene>.png` for the first scenes, not picked ones; return the paths.

    A row a method, a column a view: the true surface in the sensor's field of view, the pattern's pixels tinted, and
    beneath it the predicted class with its probability once this view is known. Rows are cross-entropy, farthest view
    and uncertainty, those of them that the records hold, else all that they do.

    - `pixels`: along a side of a view.

    **Raises:** `ValueError` if there are no records, or no method that all of them hold.
    """
    present = methods_of(records, study.methods)
    methods = [method for method in _SHOWN if method in present] or present
    chosen = first_scenes(records, scenes)
    return save_pictures(chosen, folder, "views", lambda one: _picture(one, study, methods, pixels))


def _picture(record: Record, study: PyramidStudy, methods: Sequence[str], pixels: int) -> Figure:
    held = [record["methods"][method] for method in methods]
    runs = [method["runs"][0] for method in held]
    views = len(runs[0]["log_p"])
    taken = [study.poses_of(method if "views" in method else method["runs"][0])[:views] for method in held]
    pyramid = pyramid_scene(Split(record["split"]), jnp.asarray(record["scene"]), Framing(record["framing"]))
    # Four rays a pixel.
    camera = Camera(height=2 * pixels, width=2 * pixels)
    images = [[_shade(*map(np.asarray, _render(pyramid, camera, _plain(pose)))) for pose in poses] for poses in taken]

    # Inches: all methods share the first view, so it stands once, at the middle of the rows.
    tile, gap, below, left, top, margin = 1.25, 0.1, 0.36, 0.12, 0.8, 0.1 + 0.08 * max(map(len, methods))
    wide, tall = left + views * (tile + gap) + margin + 0.1, top + len(methods) * (tile + below)
    title = f"Scene {record['scene']}, {record['framing']}: {PATTERNS[record['label']]}"
    caption = f"Framed: at least {PATTERN_PIXELS} pattern pixels. Beneath: prediction so far."
    tiles = Tiles(wide, tall, title, caption)

    def place(column: int, row: int | float) -> Axes:
        x = left + column * (tile + gap) + (margin if column else 0.0)
        return tiles.place(x, top + row * (tile + below), tile, tile)

    for row, (method, run) in enumerate(zip(methods, runs, strict=True)):
        for column in range(1, views):
            axes = place(column, row)
            _tile(axes, images[row][column], record["label"], run, column)
            if row == 0:
                axes.set_title(f"view {column + 1}", fontsize=9, loc="center", pad=4)
        x, down = left + tile + margin - 0.02, top + row * (tile + below) + 0.5 * tile
        tiles.write(x, down, method, fontsize=9, fontweight="bold", ha="right")
    axes = place(0, 0.5 * (len(methods) - 1))
    _tile(axes, images[0][0], record["label"], runs[0], 0)
    axes.set_title("view 1, given", fontsize=9, loc="center", pad=4)
    return tiles.figure


def _tile(axes: Axes, image: Float[np.ndarray, "h w 3"], label: int, run: dict, view: int) -> None:
    axes.imshow(image, interpolation="antialiased")
    shows = run["pattern_pixels"][view] >= PATTERN_PIXELS
    frame(axes, NEW if shows else LINE, 1.6 if shows else 0.8)
    guess = int(np.argmax(run["log_p"][view]))
    right = guess == label
    text = f"{PATTERNS[guess]} {np.exp(run['log_p'][view][guess]):.0%}"
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


def _plain(pose: Pose) -> Pose:
    return jax.tree.map(jnp.asarray, pose)


def _shade(
    hit: Bool[np.ndarray, " rays"], pattern: Bool[np.ndarray, " rays"], facing: Float[np.ndarray, " rays"]
) -> Float[np.ndarray, "h w 3"]:
    """Lit from the sensor; four rays a pixel."""
    colours = np.where(pattern[:, None], _TINTED, _PLAIN) * (0.4 + 0.65 * facing)[:, None]
    image = np.where(hit[:, None], np.clip(colours, 0.0, 1.0), _BACKGROUND)
    side = math.isqrt(len(hit)) // 2
    return image.reshape(side, 2, side, 2, 3).mean(axis=(1, 3))


@eqx.filter_jit
def _render(
    pyramid: Pyramid, camera: Camera, pose: Pose
) -> tuple[Bool[Array, " rays"], Bool[Array, " rays"], Float[Array, " rays"]]:
    """Which rays hit, which hit the pattern, and the cosine between each ray and its normal."""
    seen = scan(SDFSurface(pyramid), camera, pose)
    rays = pose.position - seen.points
    facing = jnp.sum(rays * seen.normals, axis=-1) / jnp.linalg.norm(rays, axis=-1)
    return seen.mask, pyramid.on_pattern(seen.points) & seen.mask, jnp.where(seen.mask, facing, 0.0)
