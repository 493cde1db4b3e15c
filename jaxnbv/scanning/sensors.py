"""The authors' usual camera and its distance, and a distance at which an object fits into the image."""

import math
from typing import NamedTuple

from jaxnbv.geometry.camera import Camera

# Room beside the object, since space near the image's border is not seen empty.
_ROOM = 1.05


class Setting(NamedTuple):
    """A camera, its distance from the object's centre in scene units, and its number of candidates."""

    camera: Camera
    radius: float
    num_candidates: int


USUAL_SETTING = Setting(Camera(), 2.5, 120)
SENSOR_RADIUS = USUAL_SETTING.radius


def fit_distance(setting: Setting, bounding_radius: float) -> Setting:
    """The setting at a distance from which its square image shows the whole object from all sides.

    There is 5 % to spare:

        sin(fov / 2) = 1.05 bounding_radius / radius

    - `bounding_radius`: radius of the ball about the origin that holds the object, in scene units.
    """
    return setting._replace(radius=_ROOM * bounding_radius / math.sin(0.5 * setting.camera.fov))
