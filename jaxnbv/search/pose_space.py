"""Where a gradient search may move the camera: on the sphere, freely, or within constraints.

A space moves a pose by a vector of parameters (a *retraction*, in the terms of optimisation on manifolds), so that
every start is the origin of its own chart: no poles, no angles, no flip of the image.
"""

import math
from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.geometry.rotations import normalise, rotation_between, rotation_from_6d, rotation_to_6d
from jaxnbv.scanning.sensors import SENSOR_RADIUS


class PoseSpace(eqx.Module):
    """The poses that a gradient search looks among.

    `num_parameters` is how many numbers move a pose.
    """

    num_parameters: eqx.AbstractClassVar[int]

    @abstractmethod
    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        """Poses of the space, spread evenly over it: always the same ones, or turned at random by a key."""

    @abstractmethod
    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        """The pose that the parameters lead to from `start`, differentiable in them.

        Zeros lead to `start`, if it is in the space.
        """

    def check_camera(self, camera: Camera) -> None:
        """Raise `ValueError` if the space makes no sense for the camera."""
        return


class SpherePoses(PoseSpace):
    """2-DOF: on the sphere of a radius about the origin, looking at it.

    The parameters (3,) are added to the unit vector from the origin to the start, and the sum is normalised. The camera
    does not roll, so that nothing singular happens at the poles. A start at another radius is moved to this one.

    **Raises:** `ValueError` unless the radius is positive and finite.
    """

    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    num_parameters: ClassVar[int] = 3

    def __check_init__(self):
        check_fields(self)
        require(0 < self.radius < math.inf, f"the sphere's radius is {self.radius}; it must be positive and finite")

    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        return _about_origin(count, self.radius, key)

    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        _, after = _directions(start, parameters)
        return Pose(_product(rotation_between(start.forward, -after), start.rotation), self.radius * after)


class FreePoses(PoseSpace):
    """6-DOF: any position and rotation.

    The parameters (9,) are added to the first two columns of the start's rotation (Zhou et al. 2019), and to its
    position. Nothing keeps the camera from turning away from the object, or from flying into it.

    - `radius`: of the sphere on which candidates for a start stand, in scene units.

    **Raises:** `ValueError` unless the radius is positive and finite.
    """

    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    num_parameters: ClassVar[int] = 9

    def __check_init__(self):
        check_fields(self)
        require(0 < self.radius < math.inf, f"the radius is {self.radius}; it must be positive and finite")

    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        return _about_origin(count, self.radius, key)

    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        rotation = rotation_from_6d(rotation_to_6d(start.rotation) + parameters[:6])
        return Pose(rotation, start.position + parameters[6:])


class ConstrainedPoses(PoseSpace):
    """6-DOF within constraints: in a shell of distances, with the object's centre in view.

    - `nearest`, `farthest`: the camera's distance from the origin, in scene units. By default about the paper's sphere,
      and outside any object: corners of the scene's cube are 2.17 away.
    - `off_axis`: greatest angle between the optical axis and the direction to the origin, in radians.

    All parameters (8,) lead to poses that obey: of the direction from the origin, as in `SpherePoses` (3); of the
    distance (1) and of where the origin stands in the image (2), each mapped into its range by s / sqrt(1 + s^2); and
    of the roll, added to (cos, sin) = (1, 0) and normalised (2). A start that does not obey is moved just inside.

    **Raises:** `ValueError` unless 0 < nearest < farthest and 0 < off_axis < pi / 2.
    """

    nearest: float = eqx.field(static=True, default=2.2)
    farthest: float = eqx.field(static=True, default=2.8)
    off_axis: float = eqx.field(static=True, default=math.radians(10.0))
    num_parameters: ClassVar[int] = 8

    def __check_init__(self):
        check_fields(self)
        require(
            0 < self.nearest < self.farthest < math.inf,
            f"the camera's distance must range from nearest > 0 to a finite farthest beyond it, not from "
            f"{self.nearest} to {self.farthest}",
        )
        require(
            0 < self.off_axis < 0.5 * math.pi,
            f"off_axis is {self.off_axis} rad; it must lie within (0, pi / 2)",
        )

    @property
    def _middle(self) -> float:
        return 0.5 * (self.nearest + self.farthest)

    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        """A sphere of them in the middle of the shell."""
        return _about_origin(count, self._middle, key)

    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        direction, distance, gaze, roll = jnp.split(parameters, (3, 4, 6))
        before, after = _directions(start, direction)
        half = 0.5 * (self.farthest - self.nearest)
        offset = jnp.linalg.norm(start.position, keepdims=True) - self._middle
        position = (self._middle + half * _move(offset / half, distance)) * after

        # Directions to the origin in the camera's frame: as the start sees it, and as it is to be seen.
        x, y, z = seen = -jnp.matmul(start.rotation.T, before, precision="highest")
        furthest = math.tan(self.off_axis)
        image = furthest * _move(jnp.stack([x, y]) / (furthest * jnp.maximum(z, 1e-3)), gaze)
        wanted = jnp.append(image, 1.0) / jnp.sqrt(1.0 + jnp.sum(image**2))
        cosine, sine = normalise(roll + jnp.asarray([1.0, 0.0]), jnp.asarray([1.0, 0.0]))
        zero, one = jnp.zeros_like(sine), jnp.ones_like(sine)
        about_axis = jnp.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one]).reshape(3, 3)

        turned = _product(rotation_between(before, after), start.rotation)
        return Pose(_product(_product(turned, rotation_between(wanted, seen)), about_axis), position)

    def check_camera(self, camera: Camera) -> None:
        """**Raises:** `ValueError` if the origin may leave the image."""
        left, top, right, bottom = camera.edges
        half = math.atan(min(-left, -top, right, bottom))
        require(
            self.off_axis <= half,
            f"off_axis is {self.off_axis:.3g} rad but the image ends {half:.3g} rad from the camera's axis: the "
            "object's centre would leave it; lower off_axis, or widen the camera's field of view",
        )


def _about_origin(count: int, radius: float, key: PRNGKeyArray | None) -> Pose:
    """A Fibonacci sphere of cameras that look at the origin, turned at random by a key."""
    places = fibonacci_sphere(count, radius)
    if key is not None:
        turn = rotation_from_6d(jax.random.normal(key, (6,)))
        places = jnp.matmul(places, turn.T, precision="highest")
    return look_at(places)


def _directions(start: Pose, parameters: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Unit vectors from the origin to the camera, before the parameters move it and after."""
    before = normalise(start.position, jnp.asarray([0.0, 0.0, 1.0], start.position.dtype))
    return before, normalise(before + parameters, before)


def _product(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    return jnp.matmul(a, b, precision="highest")


def _move(place: Float[Array, " n"], step: Float[Array, " n"]) -> Float[Array, " n"]:
    """A point of the open unit ball, moved in coordinates in which the ball is all of space."""
    length = jnp.linalg.norm(place)
    place = place * jnp.where(length > 0.99, 0.99 / jnp.maximum(length, 0.99), 1.0)
    far = place / jnp.sqrt(1.0 - jnp.sum(place**2)) + step
    return far / jnp.sqrt(1.0 + jnp.sum(far**2))
