"""The noise of real depth cameras, which measure disparities: it grows with the square of the depth."""

import math
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import check_fields, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning.scanner import SensorNoise


class DepthNoise(eqx.Module):
    """What triangulation does to a depth image: a disparity is 1/z but for a factor, so noise and rounding are the same
    at all depths in 1/z, and in z they grow as z^2,

        1/z' = step round((1/z + deviation eps) / step),   eps ~ N(0, 1).

    Points and normals are then found as of any depth image, by `PointCloud.from_depth`. Which hits return at all the
    camera says: its range and `max_incidence`.

    - `deviation`, `step`: in 1 / metre; a step of 0 does not round.
    - `scale`: scene units a metre, `frame.scale` where the world is in metres.

    **Raises:** `ValueError` for a negative deviation or step, or a scale that is not positive.
    """

    deviation: float = eqx.field(static=True)
    step: float = eqx.field(static=True, default=0.0)
    scale: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check_fields(self)
        for name in ("deviation", "step"):
            require(getattr(self, name) >= 0, f"the noise's {name} is {getattr(self, name)}; it must not be negative")
        require(self.scale > 0, f"the noise's scale is {self.scale}; it must be positive, in scene units a metre")

    @classmethod
    def kinect_v1(cls, scale: float = 1.0) -> "DepthNoise":
        """1.4 mm at a metre, in steps of 2.85 mm (Khoshelham and Oude Elberink, Sensors 12, 2012)."""
        return cls(1.425e-3, 2.85e-3, scale)

    @classmethod
    def realsense_d435(cls, scale: float = 1.0) -> "DepthNoise":
        """3.8 mm at a metre, in steps of 1.5 mm: a disparity is right to 0.08 pixels and told to 1/32, with a baseline
        of 50 mm and 848 pixels across 90 degrees (Intel's papers on tuning and on subpixel linearity)."""
        pixels_times_metres = 848 / 2 / math.tan(math.radians(45.0)) * 0.05
        return cls(0.08 / pixels_times_metres, 1 / 32 / pixels_times_metres, scale)

    @checked
    def measured(self, depth: Float[Array, " n"], key: PRNGKeyArray) -> Float[Array, " n"]:
        """What is measured of depths in scene units, zero where there is none."""
        seen = depth > 0
        inverse = jnp.where(seen, self.scale / jnp.where(seen, depth, 1.0), 0.0)
        inverse = inverse + self.deviation * jax.random.normal(key, inverse.shape, inverse.dtype)
        if self.step > 0:
            inverse = self.step * jnp.round(inverse / self.step)
        known = seen & (inverse > 0)
        return jnp.where(known, self.scale / jnp.where(known, inverse, 1.0), 0.0)

    @checked
    def __call__(self, scan: PointCloud, key: PRNGKeyArray, camera: Camera, pose: Pose) -> PointCloud:
        """What the camera makes of a scan without noise: again one row a pixel. A pixel whose depth is rounded to
        nothing, or whose neighbours have no plane, is invalid.

        **Raises:** `ValueError` if the scan is no image of the camera.
        """
        require(
            scan.mask.shape == (camera.num_rays,),
            f"the scan has rows of shape {scan.mask.shape} but the camera {camera.num_rays} rays: give its camera",
        )
        depth = jnp.matmul(scan.points - pose.position, pose.forward, precision="highest")
        depth = self.measured(jnp.where(scan.mask, depth, 0.0), key)
        missed = jnp.zeros_like(scan.mask) if scan.missed is None else scan.missed
        image = jnp.where(missed, jnp.inf, depth).reshape(camera.height, camera.width)
        return PointCloud.from_depth(image, camera, pose)


Noise: TypeAlias = SensorNoise | DepthNoise
"""What a sensor makes of a scan without noise: a function of the scan, a key, the camera and the pose."""
