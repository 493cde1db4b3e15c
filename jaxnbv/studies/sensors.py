"""Cameras and candidates of the paper's part and heat experiments, which differ from the default."""

from jaxnbv.geometry.camera import Camera
from jaxnbv.scanning.sensors import Setting

PART_SETTING = Setting(Camera(height=64, width=64), 2.0, 120)
HEAT_SETTING = Setting(Camera(), 3.0, 100)
