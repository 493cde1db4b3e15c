"""Settings of the paper's experiments on parts and on heat, which differ from `USUAL_SETTING`."""

from jaxnbv.geometry.camera import Camera
from jaxnbv.scanning.sensors import Setting

PART_SETTING = Setting(Camera(height=64, width=64), 2.0, 120)
HEAT_SETTING = Setting(Camera(), 3.0, 100)
