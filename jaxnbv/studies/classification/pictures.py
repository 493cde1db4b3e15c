"""The qualitative figure of a study of classification: what the sensor saw, view by view and method by method."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning import scan
from jaxnbv.studies.classification.measures import CUE_PIXELS
from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.engine.measures import Record, methods_of
from jaxnbv.studies.engine.pictures import Grid, first_scenes, write_grids
from jaxnbv.studies.engine.study import Scene
from jaxnbv.viz.layout import framed
from jaxnbv.viz.style import GREY, NEW

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
    methods = methods_of(records, study.methods, _SHOWN)
    return write_grids(first_scenes(records, scenes), folder, "views", lambda one: _views(one, study, methods, pixels))


def _views(record: Record, study: ClassificationStudy, methods: Sequence[str], pixels: int) -> Grid:
    held = [record["methods"][method] for method in methods]
    runs, poses = [method["runs"][0] for method in held], [study.poses_of(method) for method in held]
    scene, names = study.scene(record["scene"]), study.objects.classes
    # Four rays a pixel.
    camera = Camera(height=2 * pixels, width=2 * pixels)

    def draw(axes: Axes, row: int, column: int) -> None:
        axes.imshow(_image(scene, camera, poses[row][column], bool(study.cue)), interpolation="antialiased")
        if study.cue and runs[row][f"{study.cue}_pixels"][column] >= CUE_PIXELS:
            framed(axes, NEW, 1.6)
        log_p = runs[row]["log_p"][column]
        guess = int(np.argmax(log_p))
        right = guess == record["label"]
        text = f"{'✓ ' if right else ''}{names[guess]} {np.exp(log_p[guess]):.0%}"
        axes.set_xlabel(text, fontsize=9, color=_RIGHT if right else GREY, fontweight="bold" if right else "normal")

    title = f"Scene {record['scene']}, {record['framing']}: {names[record['label']]}"
    caption = f"Framed: at least {CUE_PIXELS} {study.cue} pixels. " if study.cue else ""
    columns = [f"view {view + 1}" for view in range(len(runs[0]["log_p"]))]
    return Grid(title, f"{caption}Beneath: prediction so far. View 1 is given.", methods, columns, draw)


def _image(scene: Scene, camera: Camera, pose: Pose, tinted: bool) -> Float[np.ndarray, "h w 3"]:
    """Lit from the sensor; four rays a pixel. Tinted where its cue is."""
    seen = scan(scene.surface, camera, jax.tree.map(jnp.asarray, pose))
    on_cue = np.asarray(scene.task.thing.on_cue(seen.points)) if tinted else np.zeros(len(seen.mask), bool)
    points, normals, hit = (np.asarray(array) for array in (seen.points, seen.normals, seen.mask))
    rays = pose.position - points
    facing = np.where(hit, np.sum(rays * normals, axis=-1) / np.linalg.norm(rays, axis=-1), 0.0)
    colours = np.where(on_cue[:, None], _TINTED, _PLAIN) * (0.4 + 0.65 * facing)[:, None]
    image = np.where(hit[:, None], np.clip(colours, 0.0, 1.0), _BACKGROUND)
    side = camera.height // 2
    return image.reshape(side, 2, side, 2, 3).mean(axis=(1, 3))
