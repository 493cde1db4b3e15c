"""Surfaces that rays can hit, simulated scans of them, sensor noise, and the derivatives of hits.

A scan is the paper's scan(theta; f): the oriented points of surface f that a depth camera sees from pose theta.
"""

import math
import warnings
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray, check_fields, checked, is_traced, require, takes_native
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.programs import program

# A camera farther than this from the scene's origin probably has its pose in other units. The limit, in scene units, is
# forty times the longest side of an object.
_MAX_CAMERA_DISTANCE = 100.0


class Hits(eqx.Module):
    """The first point at which each ray hits a surface.

    - `points`: the hits, in scene coordinates; zero where the ray misses.
    - `normals`: unit normals that point to the side of the ray's origin; zero where the ray misses.
    - `mask`: whether each ray hits the surface.
    """

    points: Float[Array, "rays 3"]
    normals: Float[Array, "rays 3"]
    mask: Bool[Array, "rays"]


class Surface(eqx.Module):
    """Base class of everything that rays can hit.

    - `in_jit`: whether `trace` runs under JAX transformations. If not, host code traces the rays.
    """

    in_jit: eqx.AbstractClassVar[bool]

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        for name in {"trace", "contains"} & vars(cls).keys():
            setattr(cls, name, takes_native(vars(cls)[name]))

    @abstractmethod
    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        """Return the first hits of the rays origin + t direction, t >= 0, with unit directions.

        A ray can hit a surface from both sides, so a ray that starts inside a solid hits its boundary from within.
        """

    def contains(self, points: Float[AnyArray, "n 3"]) -> Bool[AnyArray, " n"]:
        """Return, for each point (scene coordinates), whether the surface encloses it. The default is False."""
        return np.zeros(len(points), bool)

    @property
    def class_label(self) -> Int[AnyArray, ""] | None:
        """Index of the object's class; None if the object has no class."""
        return None

    def part_labels(self, points: Float[Array, "n 3"]) -> Int[Array, " n"] | None:
        """Return the index of the part that each surface point belongs to; None for an object without parts."""
        return None

    @property
    def world_frame(self) -> Frame | None:
        """The frame that maps the surface's world to the scene. None if the world is the scene."""
        return None


class SensorNoise(eqx.Module):
    """Independent Gaussian noise on the points and normals of a scan. The defaults are the authors'.

    A point x becomes x + eps with eps ~ N(0, points^2 I). A normal n becomes n + eta with eta ~ N(0, normals^2 I), and
    is then normalised.

    - `points`, `normals`: standard deviations of a coordinate, in scene units, and of a component of a unit normal.
    """

    points: float = eqx.field(static=True, default=0.01)
    normals: float = eqx.field(static=True, default=0.01)

    def __check_init__(self):
        check_fields(self)
        deviations = f"{self.points} and {self.normals}"
        require(
            min(self.points, self.normals) >= 0,
            f"the noise's standard deviations are {deviations}; they must not be negative",
        )

    def __call__(
        self, cloud: PointCloud, key: PRNGKeyArray, camera: Camera | None = None, pose: Pose | None = None
    ) -> PointCloud:
        """Return the cloud with noise on its filled rows. `camera` is ignored.

        If `pose`, the camera's pose, is given, `sight` becomes the distance from the camera to the noisy points.
        """
        point_key, normal_key = jax.random.split(key)
        points = cloud.points + self.points * jax.random.normal(point_key, cloud.points.shape, cloud.points.dtype)
        normals = cloud.normals + self.normals * jax.random.normal(normal_key, cloud.normals.shape, cloud.points.dtype)
        normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
        mask = cloud.mask[..., None]
        points, normals = jnp.where(mask, points, 0.0), jnp.where(mask, normals, 0.0)
        sight = cloud.sight
        if sight is not None and pose is not None:
            ranges = jnp.linalg.norm(points - pose.position[..., None, :], axis=-1)
            sight = jnp.where(cloud.mask, ranges, sight)
        return PointCloud(points, normals, cloud.mask, cloud.missed, sight)


class DepthNoise(eqx.Module):
    """Noise and rounding of a depth camera that triangulates, such as a stereo camera.

    Such a camera measures a disparity, which is 1/z times a constant. So the noise and the step of 1/z are the same at
    all depths z, and the errors of z itself grow as z^2:

        1/z' = step round((1/z + deviation eps) / step),   eps ~ N(0, 1).

    `PointCloud.from_depth` then computes points and normals from the noisy image. `scan` has already removed hits out
    of the camera's range or beyond its `max_incidence`.

    - `deviation`, `step`: standard deviation and step of 1/z, in 1 / metre; a step of 0 does not round.
    - `scale`: scene units per metre; `frame.scale` if the world is in metres.

    **Raises:** `ValueError` for a negative deviation or step, or a scale that is not positive.
    """

    deviation: float = eqx.field(static=True)
    step: float = eqx.field(static=True, default=0.0)
    scale: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check_fields(self)
        for name in ("deviation", "step"):
            require(getattr(self, name) >= 0, f"the noise's {name} is {getattr(self, name)}; it must not be negative")
        require(self.scale > 0, f"the noise's scale is {self.scale}; it must be positive, in scene units per metre")

    @classmethod
    def kinect_v1(cls, scale: float = 1.0) -> "DepthNoise":
        """Return noise of 1.4 mm at 1 m, in steps of 2.85 mm (Khoshelham and Oude Elberink, Sensors 12, 2012)."""
        return cls(1.425e-3, 2.85e-3, scale)

    @classmethod
    def realsense_d435(cls, scale: float = 1.0) -> "DepthNoise":
        """Return noise of 3.8 mm at 1 m, in steps of 1.5 mm (Intel's papers on tuning and subpixel linearity).

        Disparities have errors of 0.08 and steps of 1/32 pixel. The baseline is 50 mm, and 848 pixels span 90 degrees.
        """
        pixels_times_metres = 848 / 2 / math.tan(math.radians(45.0)) * 0.05
        return cls(0.08 / pixels_times_metres, 1 / 32 / pixels_times_metres, scale)

    @checked
    def apply(self, depth: Float[Array, " n"], key: PRNGKeyArray) -> Float[Array, " n"]:
        """Add noise to exact depths (scene units). A depth of zero means "no depth", before and after."""
        has_depth = depth > 0
        inverse = jnp.where(has_depth, self.scale / jnp.where(has_depth, depth, 1.0), 0.0)
        inverse = inverse + self.deviation * jax.random.normal(key, inverse.shape, inverse.dtype)
        if self.step > 0:
            inverse = self.step * jnp.round(inverse / self.step)
        is_measured = has_depth & (inverse > 0)
        return jnp.where(is_measured, self.scale / jnp.where(is_measured, inverse, 1.0), 0.0)

    @checked
    def __call__(self, scan: PointCloud, key: PRNGKeyArray, camera: Camera, pose: Pose) -> PointCloud:
        """Add noise to a scan.

        A pixel becomes invalid if its noisy inverse depth is zero or negative, or if no plane fits its neighbours.

        **Raises:** `ValueError` if the scan does not have one row per ray of the camera.
        """
        require(
            scan.mask.shape == (camera.num_rays,),
            f"the scan has rows of shape {scan.mask.shape} but the camera {camera.num_rays} rays: give the camera that "
            "took it",
        )
        depth = jnp.matmul(scan.points - pose.position, pose.forward, precision="highest")
        depth = self.apply(jnp.where(scan.mask, depth, 0.0), key)
        missed = jnp.zeros_like(scan.mask) if scan.missed is None else scan.missed
        image = jnp.where(missed, jnp.inf, depth).reshape(camera.height, camera.width)
        return PointCloud.from_depth(image, camera, pose)


Noise: TypeAlias = SensorNoise | DepthNoise
"""Sensor noise: a callable that takes an exact scan, a key, the camera and the pose, and returns the noisy scan."""


def distance_problem(pose: Pose) -> str | None:
    """Return a message if a camera is so far away that its pose must be in wrong units; else None."""
    distance = float(np.linalg.norm(np.asarray(pose.position), axis=-1).max(initial=0.0))
    if distance <= _MAX_CAMERA_DISTANCE:
        return None
    return (
        f"a camera stands {distance:.4g} scene units from the middle of the scene, where an object's longest side is "
        "2.5. Is its pose in millimetres or metres? Bring it to the scene with Frame.to_scene(pose), or use a Session"
    )


@checked
def scan(
    surface: Surface, camera: Camera, pose: Pose, barrier: Float[Array, "*batch rays"] | None = None
) -> PointCloud:
    """Return the scan of a surface from a pose: one row per pixel, without noise.

    A row is missed if its ray hits nothing within the camera's range. A row is invalid if the hit is too near for the
    camera, or if its angle of incidence is too large. Points are in scene coordinates. Normals have unit length and
    point towards the sensor. A batch of poses gives a batch of clouds. `SensorNoise` or `DepthNoise` adds noise.

    - `barrier`: distance along each ray to the first obstacle. A ray that reaches it before the surface is missed.

    Runs under `jit` if `surface.in_jit`. Warns if the scan is empty and the pose seems to be in wrong units.
    """
    origins, directions = camera.rays(pose)
    hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
    cloud = _measurable_hits(hits, origins, directions, camera, pose, barrier)
    if not is_traced(pose, cloud) and (problem := distance_problem(pose)) and not bool(cloud.mask.any()):
        warnings.warn(f"the scan sees nothing: {problem}", stacklevel=3)
    return cloud


@program
def _measurable_hits(
    hits: Hits,
    origins: Float[Array, "*batch rays 3"],
    directions: Float[Array, "*batch rays 3"],
    camera: Camera,
    pose: Pose,
    barrier: Float[Array, "*batch rays"] | None,
) -> PointCloud:
    shape = origins.shape[:-1]
    mask = hits.mask.reshape(shape)
    points, normals = hits.points.reshape(*shape, 3), hits.normals.reshape(*shape, 3)
    if barrier is not None:
        mask = mask & (jnp.linalg.norm(points - origins, axis=-1) < barrier)
        points, normals = (jnp.where(mask[..., None], rows, 0.0) for rows in (points, normals))
    missed = ~mask
    if camera.limited:
        depth = jnp.einsum("...rd,...d->...r", points - origins, pose.forward, precision="highest")
        is_beyond = jnp.zeros_like(mask) if camera.farthest is None else depth > camera.farthest
        cosine = -jnp.sum(normals * directions, axis=-1)
        mask = mask & ~is_beyond & (depth >= camera.nearest) & (cosine >= math.cos(camera.max_incidence))
        missed = missed | is_beyond
        points, normals = (jnp.where(mask[..., None], rows, 0.0) for rows in (points, normals))
    sight = jnp.where(mask, jnp.linalg.norm(points - origins, axis=-1), jnp.inf)
    return PointCloud(points, normals, mask, missed, sight)


@eqx.filter_custom_jvp
def implicit_depth(
    field_along_ray: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    depth: Float[Array, " n"],
    mask: Bool[Array, " n"],
    least_slope: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Return `depth` unchanged, but with derivatives (of any order) from the implicit function theorem.

    A ray meets the surface at the depth t where a function f is zero. f and t depend on parameters theta of the ray and
    of the surface: f(theta, t(theta)) = 0. So dt = -(df/dtheta dtheta) / (df/dt).

    - `field_along_ray`: a module that returns f at a given depth along each ray. Its arrays are the parameters theta.
    - `depth`: depth t of a root of f on each ray, computed by any method.
    - `mask`: whether each ray hits the surface. The derivative is zero for rays that miss.
    - `least_slope`: least slope |df/dt| for each ray. A smaller slope is replaced by this value with the slope's sign,
      since the derivative is unbounded for a ray that runs along the surface.
    """
    return depth


@implicit_depth.def_jvp
def _implicit_depth_jvp(primals, tangents):
    field_along_ray, depth, mask, least_slope = primals
    depth = implicit_depth(field_along_ray, depth, mask, least_slope)
    _, slope = jax.jvp(field_along_ray, (depth,), (jnp.ones_like(depth),))
    slope = jnp.where(jnp.abs(slope) < least_slope, jnp.where(slope < 0, -least_slope, least_slope), slope)
    _, change = eqx.filter_jvp(lambda field: field(depth), (field_along_ray,), (tangents[0],))
    return depth, jnp.where(mask, -change / jnp.where(slope == 0, 1.0, slope), 0.0)


def pixel_area(scan: PointCloud, camera: Camera, pose: Pose, least_cosine: float) -> Float[Array, " rays"]:
    """Return the surface area that each pixel shows, in squared scene units; zero if it has no point.

    The area is r^2 omega / cos = z^3 / (r fx fy cos), with the pixel's distance r, depth z and solid angle omega, the
    focal lengths fx and fy in pixels, and the cosine of incidence cos.

    - `least_cosine`: a smaller cosine of incidence is replaced by this value.
    """
    offset = jnp.where(scan.mask[:, None], scan.points - pose.position, pose.forward)
    depth = jnp.matmul(offset, pose.forward, precision="highest")
    distance = jnp.linalg.norm(offset, axis=-1)
    cosine = jnp.abs(jnp.sum(offset * scan.normals, axis=-1)) / distance
    across, down = camera.focal_lengths
    facing_area = depth**3 / (distance * across * down)
    return jnp.where(scan.mask, facing_area / jnp.maximum(cosine, least_cosine), 0.0)
