"""The poses that a search chooses among, as a value: a search says how, its candidates say where."""

import math
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray

from jaxnbv.checks import AnyArray, InputError, check_fields, require, shown
from jaxnbv.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.search.rotations import rotation_between, rotation_from_6d
from jaxnbv.sensors import SENSOR_RADIUS


class Candidates(eqx.Module):
    """Where the camera may stand, a number of poses that is fixed."""

    @property
    @abstractmethod
    def count(self) -> int:
        """How many poses there are."""

    @abstractmethod
    def poses(self, key: PRNGKeyArray | None = None) -> Pose:
        """The poses (count,): always the same ones or, where any others would do as well, turned at random by a key."""

    def where(self, allowed: Callable[[Pose], Bool[AnyArray, ""] | bool]) -> "GivenPoses":
        """Those that a predicate of one pose allows: that a robot can reach, say.

        **Raises:** `ValueError` if it allows none.
        """
        poses = self.poses()
        rows = np.array([bool(allowed(poses[index])) for index in range(self.count)])
        require(rows.any(), f"none of {self.count} candidates is allowed: give more, or allow more")
        return GivenPoses(poses[jnp.asarray(np.flatnonzero(rows))])


class SphereCandidates(Candidates):
    """The paper's pool: a Fibonacci sphere of cameras that look at the origin, or the part of it above an elevation.

    - `number`: of cameras, evenly spaced on what there is of the sphere.
    - `radius`: in scene units.
    - `min_elevation`: radians above the plane through the origin across `up`; 0 leaves a dome over a table.
    - `up`: the direction that is upward, in the scene and in the images.

    **Raises:** `ValueError` for no cameras, a radius that is not positive and finite, an elevation that is not within
    [-pi/2, pi/2), or an `up` without direction.
    """

    number: int = eqx.field(static=True, default=120)
    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    min_elevation: float = eqx.field(static=True, default=-0.5 * math.pi)
    up: tuple[float, float, float] = eqx.field(static=True, default=(0.0, 1.0, 0.0))

    def __check_init__(self):
        check_fields(self)
        require(self.number >= 1, f"the search has {self.number} candidates; it needs at least one")
        require(0 < self.radius < math.inf, f"the candidates' sphere has radius {self.radius}; it must be positive")
        require(
            -0.5 * math.pi <= self.min_elevation < 0.5 * math.pi,
            f"the least elevation is {self.min_elevation} rad; it must lie within [-pi/2, pi/2)",
        )
        require(0 < math.hypot(*self.up) < math.inf, f"up is {self.up}; it must be a direction, such as (0, 1, 0)")

    @property
    def count(self) -> int:
        return self.number

    def poses(self, key: PRNGKeyArray | None = None) -> Pose:
        """A dome is turned about its axis, so that the poses of every key are above the elevation."""
        whole = self.min_elevation == -0.5 * math.pi
        places = fibonacci_sphere(self.number, self.radius, self.min_elevation)
        if key is not None:
            turn = rotation_from_6d(jax.random.normal(key, (6,))) if whole else _about_y(key)
            places = jnp.matmul(places, turn.T, precision="highest")
        up = jnp.asarray(self.up, places.dtype)
        if self.up[0] or self.up[2] or self.up[1] < 0:
            turn = rotation_between(jnp.asarray([0.0, 1.0, 0.0], places.dtype), up / jnp.linalg.norm(up))
            places = jnp.matmul(places, turn.T, precision="highest")
        return look_at(places, up=up)


class GivenPoses(Candidates):
    """These poses, whatever the key.

    **Raises:** `ValueError` unless they are a batch (n,) of one at least.
    """

    given: Pose

    def __check_init__(self):
        check_fields(self)
        shape = jnp.shape(self.given.position)
        require(len(shape) == 2 and shape[0] >= 1, f"the poses have shape {shape[:-1]}; give a batch (n,) of them")

    @property
    def count(self) -> int:
        return self.given.position.shape[0]

    def poses(self, key: PRNGKeyArray | None = None) -> Pose:
        return self.given


def as_candidates(value: object) -> Candidates:
    """A number of cameras on the paper's sphere, or a batch of poses, as candidates.

    **Raises:** `ValueError` for anything else, and as these do.
    """
    if isinstance(value, Candidates):
        return value
    if isinstance(value, Pose):
        return GivenPoses(value)
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return SphereCandidates(int(value))
    raise InputError(f"the candidates are {shown(value)}: give how many, a batch of poses, or SphereCandidates(...)")


def sphere_candidates(count: int, radius: float = SENSOR_RADIUS) -> Pose:
    """The poses of `SphereCandidates`."""
    return SphereCandidates(count, radius).poses()


def _about_y(key: PRNGKeyArray) -> Array:
    angle = jax.random.uniform(key, maxval=2.0 * jnp.pi)
    cosine, sine, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros(()), jnp.ones(())
    return jnp.stack([cosine, zero, sine, zero, one, zero, -sine, zero, cosine]).reshape(3, 3)
