"""The authors' sensors: which camera each task has, and how far from the object's centre it stands."""

from typing import NamedTuple

from jaxnbv.camera import Camera


class Setting(NamedTuple):
    """A camera, its distance from the object's centre in scene units, and how many candidates there are at it."""

    camera: Camera
    radius: float
    num_candidates: int


USUAL_SETTING = Setting(Camera(), 2.5, 120)
PART_SETTING = Setting(Camera(height=64, width=64), 2.0, 120)
HEAT_SETTING = Setting(Camera(), 3.0, 100)
SENSOR_RADIUS = USUAL_SETTING.radius
