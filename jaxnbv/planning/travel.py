"""What it costs to go from one view to the next, and how that counts against the value of a view."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.checks import check_fields, checked, require, returned
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.observations import Observations
from jaxnbv.utility import Quantity

CostFunction: TypeAlias = Callable[[Pose, Pose], Float[Array, ""]]
"""What it costs to go from one pose to another, in units of the user's: not negative, made of JAX operations. A
session's poses are in the world, a simulation's in the scene."""


_COST, _ONE_NUMBER = "the cost of going from one pose to another", "make it one number a pose, finite and zero or more"


class ArcLength(eqx.Module):
    """Length of the way from one camera's place to another's about a centre: of the great circle where both are equally
    far from it, hypot(mean distance x angle, difference of distances) in general.

    - `center`: by default the middle of the scene, in a session that of the box.
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
    """The cost in the world of going from one pose of the scene to another.

    - `of`: a cost of poses in the world; an `ArcLength` without a centre is one about the middle of the scene.
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
    """How the cost of going to a view counts against its value: value / (fixed + cost).

    - `of`: what it costs to go from one pose to another: `arc_length`, or a function of yours. In a session it is given
      poses in the world.
    - `fixed`: what every view costs wherever it is, such as the time that an image takes, in the units of `of`.

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
        """The values of poses, given the cost of going there from the last pose that was taken, if there is one."""
        cost = jax.vmap(lambda pose: returned(self.of(observations.poses.last, pose), _COST, 0, _ONE_NUMBER))(poses)
        # A view is not chosen because its cost is wrong: the planner refuses it, see `total_cost`.
        cost = jnp.where((cost >= 0) & (cost < jnp.inf), cost, jnp.nan)
        return values / (self.fixed + jnp.where(observations.num_views > 0, cost, 0.0))

    def in_world(self, frame: Frame) -> "ValuePerCost":
        """The same for poses of a scene, where `of` is the cost of poses in the world."""
        of = self.of.of if isinstance(self.of, WorldCost) else self.of
        return dataclasses.replace(self, of=WorldCost(of, frame))

    def quantity(self, value: Quantity) -> Quantity:
        """What a value over its cost is, for a value of this quantity."""
        meaning = f"{value.meaning.rstrip('.')}, over the cost of going there."
        unit = f"{value.unit or ('' if value.length_power else value.name)} per unit of cost".lstrip()
        return dataclasses.replace(value, name=f"{value.name} per cost", unit=unit, meaning=meaning)


@checked
def total_cost(poses: Sequence[Pose], cost: CostFunction = arc_length) -> float:
    """What the way through some poses, in their order, costs; zero for one or none.

    **Raises:** `ValueError` for a cost that is not one finite number, zero or more.
    """
    way = 0.0
    for start, end in itertools.pairwise(poses):
        found = float(returned(cost(start, end), _COST, 0, _ONE_NUMBER))
        require(0 <= found < math.inf, f"{_COST} is {found}: make it one finite number, zero or more")
        way += found
    return way
