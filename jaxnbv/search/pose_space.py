"""Pose spaces of gradient searches: a sphere, all poses, or poses within constraints.

A space moves a start pose by a vector of parameters (a *retraction* in optimisation on manifolds). Zero parameters give
the start itself, so no start is near a singularity of the parameters, such as the poles of spherical coordinates.
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
    """Base class of pose spaces, the sets of poses that a gradient search can reach."""

    num_parameters: eqx.AbstractClassVar[int]

    @abstractmethod
    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        """Return `count` poses spread evenly over the space. With a key, all get the same random rotation."""

    @abstractmethod
    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        """Move `start` by the parameters, differentiably.

        If `start` lies in the space, zero parameters return it unchanged.
        """

    def check_camera(self, camera: Camera) -> None:
        """Raise `ValueError` if the camera's field of view is too narrow to show the origin from every pose.

        The default accepts every camera.
        """
        return


class SpherePoses(PoseSpace):
    """2-DOF poses on a sphere of `radius` (scene units) about the origin, all looking at the origin.

    The parameters (3,) are added to the unit vector from the origin to the start, and the sum is normalised. The camera
    turns to the origin by the smallest rotation, without a singularity at the poles. A start off the sphere moves onto
    the sphere.

    **Raises:** `ValueError` unless the radius is positive and finite.
    """

    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    num_parameters: ClassVar[int] = 3

    def __check_init__(self):
        check_fields(self)
        require(0 < self.radius < math.inf, f"the sphere's radius is {self.radius}; it must be positive and finite")

    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        return _sphere_poses(count, self.radius, key)

    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        _, new_direction = _directions(start, parameters)
        rotation = _product(rotation_between(start.forward, -new_direction), start.rotation)
        return Pose(rotation, self.radius * new_direction)


class FreePoses(PoseSpace):
    """6-DOF poses with any position and rotation.

    Six parameters are added to the first two columns of the start's rotation (Zhou et al. 2019), and three to the
    start's position. The camera may turn away from the object, or enter the object. Candidates lie on a sphere of
    `radius` (scene units).

    **Raises:** `ValueError` unless the radius is positive and finite.
    """

    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    num_parameters: ClassVar[int] = 9

    def __check_init__(self):
        check_fields(self)
        require(0 < self.radius < math.inf, f"the radius is {self.radius}; it must be positive and finite")

    def candidates(self, count: int, key: PRNGKeyArray | None) -> Pose:
        return _sphere_poses(count, self.radius, key)

    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        rotation = rotation_from_6d(rotation_to_6d(start.rotation) + parameters[:6])
        return Pose(rotation, start.position + parameters[6:])


class ConstrainedPoses(PoseSpace):
    """6-DOF poses within a range of distances from the origin, with the origin in view.

    - `nearest`, `farthest`: range of distances from the origin, in scene units. The default range contains the paper's
      sphere, and is outside any object, because the corners of the scene's cube have distance 2.17.
    - `off_axis`: largest angle between the optical axis and the direction to the origin, in radians.

    The pose satisfies the constraints for any parameters (8,):

    - Three parameters move the direction from the origin, as in `SpherePoses`.
    - One parameter moves the distance, and two move the point at which the image shows the origin. The map
      s / sqrt(1 + s^2) from all numbers s into (-1, 1) keeps the distance and the point in their ranges.
    - Two parameters are added to (1, 0), and the sum is normalised. The result is the cosine and sine of a roll angle.

    A start that violates the constraints is first moved to just inside them.

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
        return _sphere_poses(count, self._middle, key)

    def retract(self, start: Pose, parameters: Float[Array, " parameters"]) -> Pose:
        direction, distance, gaze, roll = jnp.split(parameters, (3, 4, 6))
        old_direction, new_direction = _directions(start, direction)
        half_range = 0.5 * (self.farthest - self.nearest)
        offset = jnp.linalg.norm(start.position, keepdims=True) - self._middle
        position = (self._middle + half_range * _move(offset / half_range, distance)) * new_direction

        # Directions to the origin in the camera's frame, now and after the move.
        x, y, z = to_origin = -jnp.matmul(start.rotation.T, old_direction, precision="highest")
        max_tangent = math.tan(self.off_axis)
        plane_point = max_tangent * _move(jnp.stack([x, y]) / (max_tangent * jnp.maximum(z, 1e-3)), gaze)
        target = jnp.append(plane_point, 1.0) / jnp.sqrt(1.0 + jnp.sum(plane_point**2))
        cosine, sine = normalise(roll + jnp.asarray([1.0, 0.0]), jnp.asarray([1.0, 0.0]))
        zero, one = jnp.zeros_like(sine), jnp.ones_like(sine)
        roll_matrix = jnp.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one]).reshape(3, 3)

        rotation = _product(rotation_between(old_direction, new_direction), start.rotation)
        return Pose(_product(_product(rotation, rotation_between(target, to_origin)), roll_matrix), position)

    def check_camera(self, camera: Camera) -> None:
        """Raise `ValueError` if these poses could leave the origin outside the image.

        They keep it within `off_axis` (radians) of the optical axis.
        """
        left, top, right, bottom = camera.edges
        half = math.atan(min(-left, -top, right, bottom))
        require(
            self.off_axis <= half,
            f"off_axis is {self.off_axis:.3g} rad but the image ends {half:.3g} rad from the camera's axis: the "
            "object's centre would leave it; lower off_axis, or widen the camera's field of view",
        )


def _sphere_poses(count: int, radius: float, key: PRNGKeyArray | None) -> Pose:
    """Return cameras on a Fibonacci sphere that look at the origin. A key rotates the sphere at random."""
    positions = fibonacci_sphere(count, radius)
    if key is not None:
        rotation = rotation_from_6d(jax.random.normal(key, (6,)))
        positions = jnp.matmul(positions, rotation.T, precision="highest")
    return look_at(positions)


def _directions(start: Pose, parameters: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return the unit vectors from the origin to the camera, before and after the parameters move it."""
    old_direction = normalise(start.position, jnp.asarray([0.0, 0.0, 1.0], start.position.dtype))
    return old_direction, normalise(old_direction + parameters, old_direction)


def _product(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    return jnp.matmul(a, b, precision="highest")


def _move(point: Float[Array, " n"], step: Float[Array, " n"]) -> Float[Array, " n"]:
    """Move a point of the open unit ball by a step. The result is also in the ball, for any step.

    The step is added in the coordinates p / sqrt(1 - |p|^2) of a point p, which map the ball to the whole space.
    """
    length = jnp.linalg.norm(point)
    point = point * jnp.where(length > 0.99, 0.99 / jnp.maximum(length, 0.99), 1.0)
    coordinates = point / jnp.sqrt(1.0 - jnp.sum(point**2)) + step
    return coordinates / jnp.sqrt(1.0 + jnp.sum(coordinates**2))
