"""The authors' sensors: which camera each task has and how far away it stands; and the same where an object fits in."""

import dataclasses
import math
from typing import NamedTuple

from jaxnbv.checks import require
from jaxnbv.geometry.camera import Camera

# Beside the object: what is near the image's border is not seen to be empty.
_ROOM = 1.05


class Setting(NamedTuple):
    """A camera, its distance from the object's centre in scene units, and how many candidates there are at it."""

    camera: Camera
    radius: float
    num_candidates: int


USUAL_SETTING = Setting(Camera(), 2.5, 120)
PART_SETTING = Setting(Camera(height=64, width=64), 2.0, 120)
HEAT_SETTING = Setting(Camera(), 3.0, 100)
SENSOR_RADIUS = USUAL_SETTING.radius


def fitted(setting: Setting, bounding_radius: float, fov: float | None = None, radius: float | None = None) -> Setting:
    """The setting whose square image shows all of an object from everywhere, with a twentieth to spare:

        sin(fov / 2) = 1.05 bounding_radius / radius

    - `bounding_radius`: of the object about the origin, in scene units.
    - `fov` (radians), `radius` (scene units): where one is given the other follows; both are taken as they are. By
      default the field of view is the setting's.

    **Raises:** `ValueError` for cameras that would stand within that, or a field of view outside (0, pi).
    """
    ball = _ROOM * bounding_radius
    if radius is not None:
        least = bounding_radius if fov is not None else ball
        require(
            radius > least,
            f"cameras {radius:.4g} from the centre of an object that reaches {bounding_radius:.4g} far cannot see all "
            f"of it: give more than {least:.4g}",
        )
        fov = 2.0 * math.asin(ball / radius) if fov is None else fov
    camera = setting.camera if fov is None else dataclasses.replace(setting.camera, fov=fov)
    return setting._replace(camera=camera, radius=ball / math.sin(0.5 * camera.fov) if radius is None else radius)
