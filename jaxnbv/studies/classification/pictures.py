"""What the sensor saw, view by view and method by method, and what the classifier said then."""

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
from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.pictures import Tiles, say
from jaxnbv.studies.engine.study import Scene
from jaxnbv.viz.layout import framed
from jaxnbv.viz.style import NEW

_BACKGROUND = np.array(mpl.colors.to_rgb("#f3f5f8"))
_PLAIN, _TINTED = np.array([0.68, 0.72, 0.78]), np.array(mpl.colors.to_rgb(NEW))


def tiles(study: ClassificationStudy, record: Record, methods: Sequence[str], pixels: int) -> Tiles:
    """The true surface in the sensor's field of view, tinted where its cue is if only a part of the object is; beneath
    it the predicted class with its probability once this view is known."""
    held, scene, names = record["methods"], study.scene(record["scene"]), study.objects.classes
    poses = {method: study.poses_of(held[method]) for method in methods}
    camera = Camera(height=pixels, width=pixels)

    def tile(axes: Axes, method: str, view: int) -> None:
        axes.imshow(_image(scene, camera, poses[method][view], bool(study.cue)), interpolation="antialiased")
        if study.cue and held[method]["pixels"][0][view] >= CUE_PIXELS:
            framed(axes, NEW, 1.6)
        log_p = held[method]["log_p"][0][view]
        guess = int(np.argmax(log_p))
        say(axes, f"{names[guess]} {np.exp(log_p[guess]):.0%}", guess == record["label"])

    framing = f"Framed: at least {CUE_PIXELS} {study.cue} pixels. " if study.cue else ""
    return Tiles(f"{framing}Beneath: prediction so far, of class {names[record['label']]}. View 1 is given.", tile)


def _image(scene: Scene, camera: Camera, pose: Pose, tinted: bool) -> Float[np.ndarray, "h w 3"]:
    """Lit from the sensor, tinted where its cue is."""
    seen = scan(scene.surface, camera, jax.tree.map(jnp.asarray, pose))
    on_cue = np.asarray(scene.task.thing.on_cue(seen.points)) & tinted
    points, normals, hit = (np.asarray(array) for array in (seen.points, seen.normals, seen.mask))
    rays = pose.position - points
    facing = np.where(hit, np.sum(rays * normals, axis=-1) / np.linalg.norm(rays, axis=-1), 0.0)
    colours = np.where(on_cue[:, None], _TINTED, _PLAIN) * (0.4 + 0.65 * facing)[:, None]
    image = np.where(hit[:, None], np.clip(colours, 0.0, 1.0), _BACKGROUND)
    return image.reshape(camera.height, camera.width, 3)
