"""Surfaces that rays can hit, and the paper's scan(theta; f): the oriented points that a depth camera sees of one."""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import AnyArray, check_fields, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose

# Beyond any sensor; squares of much larger numbers are infinite.
_LOUDEST = 1e6


class Hits(eqx.Module):
    """Where rays first meet a surface.

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

    @abstractmethod
    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        """First hits of the rays origin + t direction, t >= 0, with unit directions; of either side of the surface.

        A sensor sees only what faces it: an origin inside the surface sees the surface from within, its normals turned
        to the origin like all others.
        """


class SensorNoise(eqx.Module):
    """Gaussian sensor noise: x + eps with eps ~ N(0, points^2 I), and normals n + eps, normalised again.

    - `points`: standard deviation of each coordinate, in scene units.
    - `normals`: standard deviation of each component of the unit normals.

    The defaults are the authors'.
    """

    points: float = eqx.field(static=True, default=0.01)
    normals: float = eqx.field(static=True, default=0.01)

    def __check_init__(self):
        check_fields(self)
        require(
            all(0 <= deviation <= _LOUDEST for deviation in (self.points, self.normals)),
            f"the noise's standard deviations are {self.points} and {self.normals}; "
            f"they must not be negative, nor above {_LOUDEST:g}",
        )

    def __call__(
        self, cloud: PointCloud, key: PRNGKeyArray, camera: Camera | None = None, pose: Pose | None = None
    ) -> PointCloud:
        """The cloud with noise on its filled rows, whatever took it."""
        point_key, normal_key = jax.random.split(key)
        points = cloud.points + self.points * jax.random.normal(point_key, cloud.points.shape, cloud.points.dtype)
        normals = cloud.normals + self.normals * jax.random.normal(normal_key, cloud.normals.shape, cloud.points.dtype)
        normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
        mask = cloud.mask[..., None]
        return PointCloud(jnp.where(mask, points, 0.0), jnp.where(mask, normals, 0.0), cloud.mask, cloud.missed)


@checked
def scan(
    surface: Surface, camera: Camera, pose: Pose, barrier: Float[Array, "*batch rays"] | None = None
) -> PointCloud:
    """What the camera sees of the surface from a pose: one row a pixel, missed where its ray hits nothing in its range,
    invalid where it hits what is too near, or too aslant.

    - `barrier`: how far along each ray something else stands (`Surroundings.barrier`); what is behind is missed.

    Poses with leading axes give clouds with the same leading axes. Points are in scene coordinates; normals are unit
    and turned to the sensor. No noise: apply a `SensorNoise` to the result. Runs under `jit` where `surface.in_jit`.
    """
    origins, directions = camera.rays(pose)
    hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
    return _returns(hits, origins, directions, camera, pose, barrier)


@eqx.filter_jit
def _returns(
    hits: Hits,
    origins: Float[Array, "*batch rays 3"],
    directions: Float[Array, "*batch rays 3"],
    camera: Camera,
    pose: Pose,
    barrier: Float[Array, "*batch rays"] | None,
) -> PointCloud:
    """The hits that the sensor sees, as an image."""
    shape = origins.shape[:-1]
    mask = hits.mask.reshape(shape)
    points, normals = hits.points.reshape(*shape, 3), hits.normals.reshape(*shape, 3)
    if barrier is not None:
        mask = mask & (jnp.linalg.norm(points - origins, axis=-1) < barrier)
        points, normals = (jnp.where(mask[..., None], rows, 0.0) for rows in (points, normals))
    if not camera.limited:
        return PointCloud(points, normals, mask, ~mask)
    depth = jnp.einsum("...rd,...d->...r", points - origins, pose.forward, precision="highest")
    beyond = jnp.zeros_like(mask) if camera.farthest is None else depth > camera.farthest
    cosine = -jnp.sum(normals * directions, axis=-1)
    returns = mask & ~beyond & (depth >= camera.nearest) & (cosine >= math.cos(camera.max_incidence))
    points, normals = (jnp.where(returns[..., None], rows, 0.0) for rows in (points, normals))
    return PointCloud(points, normals, returns, ~mask | beyond)
