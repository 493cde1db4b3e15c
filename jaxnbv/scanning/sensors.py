"""The authors' usual camera and its distance, and a distance at which an image shows a whole object."""

import math
from typing import NamedTuple

from jaxnbv.geometry.camera import Camera

# Width of the image relative to the object. The object must not touch the border, because space near the border of an
# image never counts as seen empty.
_MARGIN_FACTOR = 1.05


class Setting(NamedTuple):
    """A camera, its distance from the scene's origin in scene units, and the number of candidate poses."""

    camera: Camera
    radius: float
    num_candidates: int


USUAL_SETTING = Setting(Camera(), 2.5, 120)
SENSOR_RADIUS = USUAL_SETTING.radius


def fit_distance(setting: Setting, bounding_radius: float) -> Setting:
    """Return the setting with a distance from which a square image shows the whole object, from any side.

    With 5 % of room around the object, sin(fov / 2) = 1.05 bounding_radius / radius.

    - `bounding_radius`: radius of a ball about the scene's origin that holds the object, in scene units.
    """
    return setting._replace(radius=_MARGIN_FACTOR * bounding_radius / math.sin(0.5 * setting.camera.fov))
