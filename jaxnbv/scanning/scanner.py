"""Surfaces that rays can hit, the paper's scan(theta; f) (the oriented points that a depth camera sees), sensor noise,
and the derivatives of hits."""

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

# In scene units: forty times the longest side of an object.
_FAR_OFF = 100.0


class Hits(eqx.Module):
    """First hits of rays on a surface.

    - `points`: the hits, in scene coordinates; zero where the ray misses.
    - `normals`: unit normals on the side of the ray's origin; zero where the ray misses.
    - `mask`: whether the ray hits at all.
    """

    points: Float[Array, "rays 3"]
    normals: Float[Array, "rays 3"]
    mask: Bool[Array, "rays"]


class Surface(eqx.Module):
    """Anything that rays can hit.

    `in_jit` says whether `trace` runs under JAX transformations; a surface that needs host code says False.
    """

    in_jit: eqx.AbstractClassVar[bool]

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        for name in {"trace", "contains"} & vars(cls).keys():
            setattr(cls, name, takes_native(vars(cls)[name]))

    @abstractmethod
    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        """First hits of the rays origin + t direction, t >= 0, with unit directions.

        Rays hit both sides of the surface, so a ray that starts inside hits it from within. Normals point to the side
        of the origin there too.
        """

    def contains(self, points: Float[AnyArray, "n 3"]) -> Bool[AnyArray, " n"]:
        """Whether each point (scene coordinates) lies inside. All False for a surface that encloses nothing."""
        return np.zeros(len(points), bool)

    @property
    def class_label(self) -> Int[AnyArray, ""] | None:
        """Index of the object's class; None if it has none."""
        return None

    def part_labels(self, points: Float[Array, "n 3"]) -> Int[Array, " n"] | None:
        """Index of the part that each surface point belongs to; None for an object without parts."""
        return None

    @property
    def world_frame(self) -> Frame | None:
        """The frame that maps the surface's world to the scene; None if it was built in scene coordinates."""
        return None


class SensorNoise(eqx.Module):
    """Gaussian sensor noise: x + eps with eps ~ N(0, points^2 I).

    Normals become n + eps, with noise of their own, and are normalised again.

    - `points`: standard deviation of each coordinate, in scene units.
    - `normals`: standard deviation of each component of the unit normals.

    The defaults are the authors'.
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
        """The cloud with noise on its filled rows. The camera does not matter.

        If there is a pose, `sight` becomes the distance to the noisy points, so that it does not reveal exact ranges.
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
    """Noise and rounding of a depth camera that triangulates.

    A disparity is 1/z times a constant, so both are the same at all depths z in 1/z and grow as z^2 in z:

        1/z' = step round((1/z + deviation eps) / step),   eps ~ N(0, 1).

    `PointCloud.from_depth` then computes points and normals, as for any depth image. The camera's range and
    `max_incidence` decide which hits return at all.

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
        """Noise of 1.4 mm at 1 m, in steps of 2.85 mm (Khoshelham and Oude Elberink, Sensors 12, 2012)."""
        return cls(1.425e-3, 2.85e-3, scale)

    @classmethod
    def realsense_d435(cls, scale: float = 1.0) -> "DepthNoise":
        """Noise of 3.8 mm at 1 m, in steps of 1.5 mm (Intel's papers on tuning and on subpixel linearity).

        Disparities have an error of 0.08 pixels and steps of 1/32, with a baseline of 50 mm and 848 pixels across 90
        degrees.
        """
        pixels_times_metres = 848 / 2 / math.tan(math.radians(45.0)) * 0.05
        return cls(0.08 / pixels_times_metres, 1 / 32 / pixels_times_metres, scale)

    @checked
    def apply(self, depth: Float[Array, " n"], key: PRNGKeyArray) -> Float[Array, " n"]:
        """Noisy depths for exact ones, in scene units. In both, zero stands for no depth."""
        has_depth = depth > 0
        inverse = jnp.where(has_depth, self.scale / jnp.where(has_depth, depth, 1.0), 0.0)
        inverse = inverse + self.deviation * jax.random.normal(key, inverse.shape, inverse.dtype)
        if self.step > 0:
            inverse = self.step * jnp.round(inverse / self.step)
        is_measured = has_depth & (inverse > 0)
        return jnp.where(is_measured, self.scale / jnp.where(is_measured, inverse, 1.0), 0.0)

    @checked
    def __call__(self, scan: PointCloud, key: PRNGKeyArray, camera: Camera, pose: Pose) -> PointCloud:
        """The noisy scan for a scan without noise, again one row per pixel. A pixel is invalid if its inverse depth
        becomes zero or negative, or if no plane fits its neighbours.

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
"""Sensor noise: a function of a scan without noise, a key, the camera and the pose that returns the noisy scan."""


def distance_problem(pose: Pose) -> str | None:
    """A message if a pose is too far from the scene to be meant, else None. Poses must not be traced."""
    distance = float(np.linalg.norm(np.asarray(pose.position), axis=-1).max(initial=0.0))
    if distance <= _FAR_OFF:
        return None
    return (
        f"a camera stands {distance:.4g} scene units from the middle of the scene, where an object's longest side is "
        "2.5. Is its pose in millimetres or metres? Bring it to the scene with Frame.to_scene(pose), or use a Session"
    )


@checked
def scan(
    surface: Surface, camera: Camera, pose: Pose, barrier: Float[Array, "*batch rays"] | None = None
) -> PointCloud:
    """The scan of a surface from a pose, one row per pixel, without noise.

    A row is missed if its ray hits nothing within the camera's range. It is invalid if the hit is too near or at too
    large an angle of incidence. Points are in scene coordinates. Normals are unit and point towards the sensor. Poses
    with leading axes give clouds with the same leading axes. Apply a `SensorNoise` to the result for noise.

    - `barrier`: distance along each ray to an obstacle (`Obstacles.barrier`); hits behind it are missed.

    Runs under `jit` if `surface.in_jit`. Warns if the scan is empty and the camera so far away that its pose must be in
    other units.
    """
    origins, directions = camera.rays(pose)
    hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
    cloud = _returns(hits, origins, directions, camera, pose, barrier)
    if not is_traced(pose, cloud) and (problem := distance_problem(pose)) and not bool(cloud.mask.any()):
        warnings.warn(f"the scan sees nothing: {problem}", stacklevel=3)
    return cloud


@program
def _returns(
    hits: Hits,
    origins: Float[Array, "*batch rays 3"],
    directions: Float[Array, "*batch rays 3"],
    camera: Camera,
    pose: Pose,
    barrier: Float[Array, "*batch rays"] | None,
) -> PointCloud:
    """The hits that return to the sensor, as a scan."""
    shape = origins.shape[:-1]
    mask = hits.mask.reshape(shape)
    points, normals = hits.points.reshape(*shape, 3), hits.normals.reshape(*shape, 3)
    if barrier is not None:
        mask = mask & (jnp.linalg.norm(points - origins, axis=-1) < barrier)
        points, normals = (jnp.where(mask[..., None], rows, 0.0) for rows in (points, normals))
    if not camera.limited:
        return PointCloud(points, normals, mask, ~mask, _sight(points, origins, mask))
    depth = jnp.einsum("...rd,...d->...r", points - origins, pose.forward, precision="highest")
    beyond = jnp.zeros_like(mask) if camera.farthest is None else depth > camera.farthest
    cosine = -jnp.sum(normals * directions, axis=-1)
    returns = mask & ~beyond & (depth >= camera.nearest) & (cosine >= math.cos(camera.max_incidence))
    points, normals = (jnp.where(returns[..., None], rows, 0.0) for rows in (points, normals))
    return PointCloud(points, normals, returns, ~mask | beyond, _sight(points, origins, returns))


def _sight(
    points: Float[Array, "*batch rays 3"], origins: Float[Array, "*batch rays 3"], returns: Bool[Array, "*batch rays"]
) -> Float[Array, "*batch rays"]:
    return jnp.where(returns, jnp.linalg.norm(points - origins, axis=-1), jnp.inf)


@eqx.filter_custom_jvp
def implicit_depth(
    along: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    depth: Float[Array, " n"],
    mask: Bool[Array, " n"],
    grazing: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The depths t at which n rays meet a surface, differentiable in the arrays of `along`.

    From f(theta, t(theta)) = 0 follows dt = -(df/dtheta dtheta) / (df/dt). The rule applies to itself for derivatives
    of higher order.

    - `along`: a module that returns f at a depth along each ray. Its arrays are the parameters theta.
    - `depth`: the roots, f = 0, from any method. They are returned unchanged.
    - `mask`: whether each ray hits; the others have derivative zero.
    - `grazing`: least slope |df/dt|. Smaller ones are set to it and keep their sign, since the derivative is unbounded
      for a ray that runs along the surface.
    """
    return depth


@implicit_depth.def_jvp
def _implicit_depth_jvp(primals, tangents):
    along, depth, mask, grazing = primals
    depth = implicit_depth(along, depth, mask, grazing)
    _, slope = jax.jvp(along, (depth,), (jnp.ones_like(depth),))
    slope = jnp.where(jnp.abs(slope) < grazing, jnp.where(slope < 0, -grazing, grazing), slope)
    _, change = eqx.filter_jvp(lambda field: field(depth), (along,), (tangents[0],))
    return depth, jnp.where(mask, -change / jnp.where(slope == 0, 1.0, slope), 0.0)


def pixel_area(scan: PointCloud, camera: Camera, pose: Pose, steepest: float) -> Float[Array, " rays"]:
    """The area of surface that each pixel shows, in squared scene units; zero for pixels without a point.

    With focal lengths fx and fy, depth z and distance r it is r^2 omega / cos = z^3 / (r fx fy cos).

    - `scan`: the scan of this camera from this pose.
    - `steepest`: least cosine of incidence. Smaller ones count as this one.
    """
    offset = jnp.where(scan.mask[:, None], scan.points - pose.position, pose.forward)
    depth = jnp.matmul(offset, pose.forward, precision="highest")
    distance = jnp.linalg.norm(offset, axis=-1)
    cosine = jnp.abs(jnp.sum(offset * scan.normals, axis=-1)) / distance
    across, down = camera.focal_lengths
    facing = depth**3 / (distance * across * down)
    return jnp.where(scan.mask, facing / jnp.maximum(cosine, steepest), 0.0)
