"""Candidates: sets of poses from which a search chooses one."""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import AnyArray, InputError, check_fields, require, short_text
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.geometry.rotations import rotation_between
from jaxnbv.scanning.sensors import SENSOR_RADIUS

# The plastic number, which is the real root of x^3 = x + 1.
_PLASTIC = 1.324717957244746


class Candidates(eqx.Module):
    """Base class of candidates: a fixed number of camera poses."""

    @property
    @abstractmethod
    def count(self) -> int:
        """Number of poses."""

    @abstractmethod
    def poses(self) -> Pose:
        """Return the poses (count,). Every call returns the same poses."""

    def upper_half(self) -> "Candidates":
        """Return `self`, or as many candidates on the upper half if the candidates are a whole sphere."""
        return self

    def where(self, allowed: Callable[[Pose], Bool[AnyArray, ""] | bool]) -> "GivenPoses":
        """Return the candidates for which `allowed`, a function of one pose, returns True.

        **Raises:** `ValueError` if no candidate is allowed, or if the function does not return a single bool.
        """
        require(callable(allowed), f"the predicate is {short_text(allowed)}; give a function of one pose")
        poses = self.poses()
        answers = [np.asarray(allowed(poses[index])) for index in range(self.count)]
        for answer in answers:
            is_bool = answer.shape == () and answer.dtype == bool
            require(is_bool, f"the predicate returned {short_text(answer)} for a pose; it must return True or False")
        is_allowed = np.array(answers)
        require(is_allowed.any(), f"none of {self.count} candidates is allowed: give more, or allow more")
        return GivenPoses(poses[jnp.asarray(np.flatnonzero(is_allowed))])


class SphereCandidates(Candidates):
    """The paper's candidates: cameras on a sphere or part of a sphere, all looking at the origin.

    - `count`: number of cameras. They are spaced evenly above `min_elevation` (a Fibonacci sphere).
    - `radius`: radius in scene units.
    - `min_elevation`: smallest angle of a camera above the horizontal plane through the origin, in radians (0: a dome).
    - `up`: upward direction in the scene and in the images.

    **Raises:** `ValueError` for no cameras, a radius that is not positive and finite, an elevation outside
    [-pi/2, pi/2), or a zero `up`.
    """

    count: int = eqx.field(static=True, default=120)
    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    min_elevation: float = eqx.field(static=True, default=-0.5 * math.pi)
    up: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 1.0, 0.0))

    def __check_init__(self):
        check_fields(self)
        _check_positions(self.count, self.radius, self.radius, self.up)
        require(
            -0.5 * math.pi <= self.min_elevation < 0.5 * math.pi,
            f"the least elevation is {self.min_elevation} rad; it must lie within [-pi/2, pi/2)",
        )

    def upper_half(self) -> "SphereCandidates":
        return dataclasses.replace(self, min_elevation=0.0) if self.min_elevation == -0.5 * math.pi else self

    def poses(self) -> Pose:
        return _look_at_origin(fibonacci_sphere(self.count, self.radius, self.min_elevation), self.up)


class Reach(Candidates):
    """Cameras within an arm's reach: between two distances and two elevations, all looking at the origin.

    - `count`: number of cameras. They fill the volume between these limits evenly.
    - `nearest`, `farthest`: smallest and largest distance from the origin, in scene units.
    - `min_elevation`, `max_elevation`: smallest and largest angle of a camera above the horizontal plane through the
      origin, in radians. Angles below the plane are negative.
    - `up`: upward direction in the scene and in the images.

    **Raises:** `ValueError` for no cameras, distances or elevations in the wrong order, or a zero `up`.
    """

    count: int = eqx.field(static=True, default=120)
    nearest: float = eqx.field(static=True, default=2.0)
    farthest: float = eqx.field(static=True, default=3.0)
    min_elevation: float = eqx.field(static=True, default=0.0)
    max_elevation: float = eqx.field(static=True, default=math.radians(80.0))
    up: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 1.0, 0.0))

    def __check_init__(self):
        check_fields(self)
        _check_positions(self.count, self.nearest, self.farthest, self.up)
        require(
            -0.5 * math.pi <= self.min_elevation < self.max_elevation <= 0.5 * math.pi,
            f"the elevations are {self.min_elevation} and {self.max_elevation} rad; the second must be greater, and "
            "both within [-pi/2, pi/2]",
        )

    def poses(self) -> Pose:
        index = np.arange(self.count)
        low, high = math.sin(self.min_elevation), math.sin(self.max_elevation)
        y = high - (high - low) * (index + 0.5) / self.count
        ring, angle = np.sqrt(1.0 - y**2), index * math.pi * (3.0 - math.sqrt(5.0))
        # Roberts' low-discrepancy sequence (2018) spreads directions and distances evenly together.
        fraction = (0.5 + index / _PLASTIC**2) % 1.0
        distance = np.cbrt(self.nearest**3 + fraction * (self.farthest**3 - self.nearest**3))
        positions = distance[:, None] * np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], axis=1)
        return _look_at_origin(jnp.asarray(positions, jnp.result_type(float)), self.up)


class GivenPoses(Candidates):
    """Candidates that are the poses of a `batch`.

    **Raises:** `ValueError` unless the poses are a batch (n,) with n >= 1.
    """

    batch: Pose

    def __check_init__(self):
        check_fields(self)
        shape = jnp.shape(self.batch.position)
        require(len(shape) == 2 and shape[0] >= 1, f"the poses have shape {shape[:-1]}; give a batch (n,) of them")

    @property
    def count(self) -> int:
        return self.batch.position.shape[0]

    def poses(self) -> Pose:
        return self.batch


def _check_positions(count: int, nearest: float, farthest: float, up: tuple[float, float, float]) -> None:
    require(count >= 1, f"the search has {count} candidates; it needs at least one")
    distances = nearest if nearest == farthest else f"{nearest} to {farthest}"
    require(
        0 < nearest <= farthest < math.inf,
        f"the candidates are {distances} away from the origin; give positive scene units, the nearest first",
    )
    require(0 < math.hypot(*up) < math.inf, f"up is {up}; it must be a direction, such as (0, 1, 0)")


def _look_at_origin(positions: Float[Array, "n 3"], up: tuple[float, float, float]) -> Pose:
    """Rotate `positions` so that the y axis becomes `up`. Return poses there that look at the origin."""
    axis = jnp.asarray(up, positions.dtype)
    if up[0] or up[2] or up[1] < 0:
        rotation = rotation_between(jnp.asarray([0.0, 1.0, 0.0], positions.dtype), axis / jnp.linalg.norm(axis))
        positions = jnp.matmul(positions, rotation.T, precision="highest")
    return look_at(positions, up=axis)


def as_candidates(value: object) -> Candidates:
    """Return `value` as candidates: `SphereCandidates` for a number, `GivenPoses` for a batch of poses.

    **Raises:** `ValueError` for any other value, and for the same reasons as `SphereCandidates` and `GivenPoses`.
    """
    if isinstance(value, Candidates):
        return value
    if isinstance(value, Pose):
        return GivenPoses(value)
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return SphereCandidates(int(value))
    raise InputError(
        f"the candidates are {short_text(value)}: give how many, a batch of poses, or SphereCandidates(...)"
    )


def sphere_candidates(count: int, radius: float = SENSOR_RADIUS) -> Pose:
    """Return the poses of `SphereCandidates(count, radius)`."""
    return SphereCandidates(count, radius).poses()
