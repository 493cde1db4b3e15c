"""The authors' usual sensor: its camera and how far away it stands; and a sensor so far away that an object fits in."""

import math
from typing import NamedTuple

from jaxnbv.geometry.camera import Camera

# Beside the object: what is near the image's border is not seen to be empty.
_ROOM = 1.05


class Setting(NamedTuple):
    """A camera, its distance from the object's centre in scene units, and how many candidates there are at it."""

    camera: Camera
    radius: float
    num_candidates: int


USUAL_SETTING = Setting(Camera(), 2.5, 120)
SENSOR_RADIUS = USUAL_SETTING.radius


def fitted(setting: Setting, bounding_radius: float) -> Setting:
    """The setting so far away that its square image shows all of an object from everywhere, with a twentieth to spare:

        sin(fov / 2) = 1.05 bounding_radius / radius

    - `bounding_radius`: of the object about the origin, in scene units.
    """
    return setting._replace(radius=_ROOM * bounding_radius / math.sin(0.5 * setting.camera.fov))
