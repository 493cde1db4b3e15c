"""The authors' sensors for single tasks, where they are not the usual one."""

from jaxnbv.geometry.camera import Camera
from jaxnbv.scanning.sensors import Setting

PART_SETTING = Setting(Camera(height=64, width=64), 2.0, 120)
HEAT_SETTING = Setting(Camera(), 3.0, 100)
