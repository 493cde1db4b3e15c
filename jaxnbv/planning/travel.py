"""Costs of moving the camera from one view to the next, and their effect on the value of a view."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.checks import check_fields, checked, checked_result, require
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.observations import Observations
from jaxnbv.utility import Quantity

CostFunction: TypeAlias = Callable[[Pose, Pose], Float[Array, ""]]
"""Function that returns the cost of moving the camera from the first pose to the second.

The cost is finite and at least zero, in any unit. The function must use JAX operations. It gets poses in world
coordinates in a session, and in scene coordinates in a simulation.
"""

_COST, _ONE_NUMBER = "the cost of going from one pose to another", "make it one number a pose, finite and zero or more"


class ArcLength(eqx.Module):
    """Length of the path between two camera positions around a centre.

    The length is hypot(0.5 (r + s) alpha, s - r), with the distances r and s of the positions from the centre and the
    angle alpha between them, seen from the centre. For r = s it is the length of the arc on a great circle.

    - `center`: the centre. The default is the middle of the scene, or the middle of the box in a session.
    """

    center: tuple[float, float, float] | None = None

    @checked
    @jax.jit
    def __call__(self, start: Pose, end: Pose) -> Float[Array, ""]:
        """Return the length, in the unit of the poses."""
        center = jnp.zeros(3) if self.center is None else jnp.asarray(self.center)
        first, second = (pose.position - center for pose in (start, end))
        radii = safe_norm(*first), safe_norm(*second)
        angle = jnp.arctan2(safe_norm(*jnp.cross(first, second)), jnp.sum(first * second))
        return safe_norm(0.5 * (radii[0] + radii[1]) * angle, radii[1] - radii[0])


arc_length = ArcLength()


class WorldCost(eqx.Module):
    """Cost of a move between scene poses, which are converted to world poses for the cost function `of`.

    An `ArcLength` without a centre uses the middle of the scene.
    """

    of: CostFunction
    frame: Frame

    def __call__(self, start: Pose, end: Pose) -> Float[Array, ""]:
        of = self.of
        if isinstance(of, ArcLength) and of.center is None:
            of = ArcLength(self.frame.center)
        return of(self.frame.to_world(start), self.frame.to_world(end))


class ValuePerCost(eqx.Module):
    """Value of a view divided by the cost of the view: value / (fixed + cost of the move).

    - `of`: cost of the move between two poses in world coordinates (in a simulation, scene coordinates): `arc_length`
      or your own function.
    - `fixed`: fixed cost of every view, in the unit of `of`, such as the time that the sensor needs for an image.

    **Raises:** `ValueError` if `fixed` is not positive.
    """

    of: CostFunction = arc_length
    fixed: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check_fields(self)
        require(self.fixed > 0, f"the fixed cost of a view is {self.fixed}; it must be positive")

    def __call__(
        self, values: Float[Array, "*samples poses"], observations: Observations, poses: Pose
    ) -> Float[Array, "*samples poses"]:
        """Return the values of poses, each divided by the fixed cost plus the cost of the move to the pose.

        The move starts at the last view. Without a view, only the fixed cost counts.
        """
        cost = jax.vmap(lambda pose: checked_result(self.of(observations.poses.last, pose), _COST, 0, _ONE_NUMBER))(
            poses
        )
        # An invalid cost becomes NaN. The planner then raises an error that names the cost, see `total_cost`.
        cost = jnp.where((cost >= 0) & (cost < jnp.inf), cost, jnp.nan)
        return values / (self.fixed + jnp.where(observations.num_views > 0, cost, 0.0))

    def in_world(self, frame: Frame) -> "ValuePerCost":
        """Return a copy that takes scene poses, and converts them to world poses for the cost function `of`."""
        of = self.of.of if isinstance(self.of, WorldCost) else self.of
        return dataclasses.replace(self, of=WorldCost(of, frame))

    def quantity(self, value: Quantity) -> Quantity:
        """Return the name, unit and meaning of value per cost, given those of the value."""
        meaning = f"{value.meaning.rstrip('.')}, over the cost of going there."
        unit = f"{value.unit or ('' if value.length_power else value.name)} per unit of cost".lstrip()
        return dataclasses.replace(value, name=f"{value.name} per cost", unit=unit, meaning=meaning)


@checked
def total_cost(poses: Sequence[Pose], cost: CostFunction = arc_length) -> float:
    """Return the cost of the path through the poses in order; zero for fewer than two poses.

    **Raises:** `ValueError` for a cost that is not a single finite number, zero or more.
    """
    total = 0.0
    for start, end in itertools.pairwise(poses):
        step = float(checked_result(cost(start, end), _COST, 0, _ONE_NUMBER))
        require(0 <= step < math.inf, f"{_COST} is {step}: make it one finite number, zero or more")
        total += step
    return total
