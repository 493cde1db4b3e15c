"""The cost of going from one view to the next, and how it counts against the value of a view."""

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
"""Function of two poses that returns the cost of going from the first to the second, in any unit, zero or more.

It must use JAX operations. Poses are in world coordinates in a session, and in scene coordinates in a simulation."""


_COST, _ONE_NUMBER = "the cost of going from one pose to another", "make it one number a pose, finite and zero or more"


class ArcLength(eqx.Module):
    """Length of the path between two camera positions around a centre.

    It is hypot(mean distance x angle, difference of distances): at equal distances, an arc of the great circle.

    - `center`: the centre, by default the middle of the scene, or of the box in a session.
    """

    center: tuple[float, float, float] | None = None

    @checked
    @jax.jit
    def __call__(self, start: Pose, end: Pose) -> Float[Array, ""]:
        """The length, in the units of the poses."""
        center = jnp.zeros(3) if self.center is None else jnp.asarray(self.center)
        first, second = (pose.position - center for pose in (start, end))
        radii = safe_norm(*first), safe_norm(*second)
        angle = jnp.arctan2(safe_norm(*jnp.cross(first, second)), jnp.sum(first * second))
        return safe_norm(0.5 * (radii[0] + radii[1]) * angle, radii[1] - radii[0])


arc_length = ArcLength()


class WorldCost(eqx.Module):
    """Cost function of poses in the scene, by a cost function of poses in the world.

    - `of`: cost of poses in world coordinates. An `ArcLength` without a centre uses the middle of the scene.
    - `frame`: frame of the user's world.
    """

    of: CostFunction
    frame: Frame

    def __call__(self, start: Pose, end: Pose) -> Float[Array, ""]:
        """The cost, in world units."""
        of = self.of
        if isinstance(of, ArcLength) and of.center is None:
            of = ArcLength(self.frame.center)
        return of(self.frame.to_world(start), self.frame.to_world(end))


class ValuePerCost(eqx.Module):
    """Value of a view divided by the cost of going there: value / (fixed + cost).

    - `of`: cost of going from one pose to another: `arc_length`, or your own function. In a session it gets poses in
      world coordinates.
    - `fixed`: fixed cost of every view in the units of `of`, for example the time of taking an image.

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
        """Values of poses, divided by the cost of going there from the last view, if there is one."""
        cost = jax.vmap(lambda pose: checked_result(self.of(observations.poses.last, pose), _COST, 0, _ONE_NUMBER))(
            poses
        )
        # An invalid cost becomes NaN, so that the planner raises and names it, see `total_cost`.
        cost = jnp.where((cost >= 0) & (cost < jnp.inf), cost, jnp.nan)
        return values / (self.fixed + jnp.where(observations.num_views > 0, cost, 0.0))

    def in_world(self, frame: Frame) -> "ValuePerCost":
        """A copy for poses in the scene, given that `of` is the cost of poses in the world."""
        of = self.of.of if isinstance(self.of, WorldCost) else self.of
        return dataclasses.replace(self, of=WorldCost(of, frame))

    def quantity(self, value: Quantity) -> Quantity:
        """Quantity of a value of this quantity divided by its cost."""
        meaning = f"{value.meaning.rstrip('.')}, over the cost of going there."
        unit = f"{value.unit or ('' if value.length_power else value.name)} per unit of cost".lstrip()
        return dataclasses.replace(value, name=f"{value.name} per cost", unit=unit, meaning=meaning)


@checked
def total_cost(poses: Sequence[Pose], cost: CostFunction = arc_length) -> float:
    """Cost of the path through the poses in order; zero for one pose or none.

    **Raises:** `ValueError` for a cost that is not one finite number, zero or more.
    """
    total = 0.0
    for start, end in itertools.pairwise(poses):
        step = float(checked_result(cost(start, end), _COST, 0, _ONE_NUMBER))
        require(0 <= step < math.inf, f"{_COST} is {step}: make it one finite number, zero or more")
        total += step
    return total
