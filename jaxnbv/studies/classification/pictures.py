"""Pictures of classification studies: the true surface from each view, with the predictions."""

from collections.abc import Sequence

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
from jaxnbv.studies.engine.episodes import poses_of
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.engine.tiles import ScenePicture, caption_tile
from jaxnbv.viz.style import NEW, draw_border

_BACKGROUND = np.array(mpl.colors.to_rgb("#f3f5f8"))
_BASE_COLOUR, _CUE_COLOUR = np.array([0.68, 0.72, 0.78]), np.array(mpl.colors.to_rgb(NEW))


def prediction_picture(
    scene: Scene, record: Record, methods: Sequence[str], pixels: int, classes: Sequence[str], cue: str
) -> ScenePicture:
    """Return a picture of the true surface from each view, with the predicted class and its probability.

    - `scene`: the scene of the record. Its `task` is the `Truth` that `ClassificationStudy.scene` makes.
    - `cue`: name of the part of the object that tells its class, which the picture tints; "" for none.
    """
    runs, truth, camera = record["methods"], record["label"], Camera(height=pixels, width=pixels)
    poses = {method: poses_of(runs[method]) for method in methods}

    def tile(axes: Axes, method: str, view: int) -> None:
        axes.imshow(_image(scene, camera, poses[method][view], bool(cue)), interpolation="antialiased")
        if cue and runs[method]["pixels"][0][view] >= CUE_PIXELS:
            draw_border(axes, NEW, 1.6)
        log_p = runs[method]["log_p"][0][view]
        guess = int(np.argmax(log_p))
        caption_tile(axes, f"{classes[guess]} {np.exp(log_p[guess]):.0%}", guess == truth)

    framing = f"Framed: at least {CUE_PIXELS} {cue} pixels. " if cue else ""
    caption = f"{framing}Beneath: prediction; true: {classes[truth]}. All methods share view 1."
    return ScenePicture(caption, tile)


def _image(scene: Scene, camera: Camera, pose: Pose, is_tinted: bool) -> Float[np.ndarray, "h w 3"]:
    """Return an image of the scene from a pose, lit from the camera; if `is_tinted`, the cue is tinted."""
    cloud = scan(scene.surface, camera, jax.tree.map(jnp.asarray, pose))
    is_on_cue = np.asarray(scene.task.class_object.on_cue(cloud.points)) & is_tinted
    points, normals, is_hit = (np.asarray(array) for array in (cloud.points, cloud.normals, cloud.mask))
    rays = pose.position - points
    cosines = np.where(is_hit, np.sum(rays * normals, axis=-1) / np.linalg.norm(rays, axis=-1), 0.0)
    colours = np.where(is_on_cue[:, None], _CUE_COLOUR, _BASE_COLOUR) * (0.4 + 0.65 * cosines)[:, None]
    image = np.where(is_hit[:, None], np.clip(colours, 0.0, 1.0), _BACKGROUND)
    return image.reshape(camera.height, camera.width, 3)
