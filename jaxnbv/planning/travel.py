"""What it costs to go from one view to the next, and how that counts against the value of a view."""

import itertools
from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.acquisition import Quantity
from jaxnbv.checks import as_numbers, check_fields, checked, require, shown
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.observations import Observations

CostFunction: TypeAlias = Callable[[Pose, Pose], Float[Array, ""]]
"""What it costs to go from one pose to another, in units of the user's: not negative, made of JAX operations."""


@checked
@jax.jit
def arc_length(start: Pose, end: Pose) -> Float[Array, ""]:
    """Length of the way from one camera's place to another's about the origin, in scene units: of the great circle
    where both are equally far from it, hypot(mean distance x angle, difference of distances) in general."""
    first, second = start.position, end.position
    radii = safe_norm(*first), safe_norm(*second)
    angle = jnp.arctan2(safe_norm(*jnp.cross(first, second)), jnp.sum(first * second))
    return safe_norm(0.5 * (radii[0] + radii[1]) * angle, radii[1] - radii[0])


class ValuePerCost(eqx.Module):
    """How the cost of going to a view counts against its value: value / (fixed + cost).

    - `of`: what it costs to go from one pose to another: `arc_length`, or a function of yours.
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
        """The values of poses, given the cost of going there from the last view, if there is one."""
        cost = jax.vmap(lambda pose: self.of(observations.last_pose, pose))(poses)
        real = isinstance(cost, Array) and not jnp.iscomplexobj(cost) and cost.shape == (len(poses.position),)
        require(real, f"the cost of going from one pose to another is {shown(cost)}: make it one number a pose")
        # A view is not chosen because its cost is wrong: the planner refuses what is not a number.
        cost = jnp.where((cost >= 0) & (cost < jnp.inf), cost, jnp.nan)
        return values / (self.fixed + jnp.where(observations.num_views > 0, cost, 0.0))

    def quantity(self, value: Quantity) -> Quantity:
        """What the weighed value is, where the value is this."""
        meaning = f"{value.meaning.rstrip('.')}, over the cost of going there."
        return Quantity(f"{value.name} per cost", f"{value.unit or value.name} per unit of cost", meaning, value.smooth)


@checked
def total_cost(poses: Sequence[Pose], cost: CostFunction = arc_length) -> float:
    """What the way through some poses, in their order, costs; zero for one or none.

    **Raises:** `ValueError` for a cost that is not one finite number, zero or more.
    """
    name, way = "the cost of going from one pose to another", 0.0
    for start, end in itertools.pairwise(poses):
        found = as_numbers(cost(start, end), name, np.float64)
        proper = found.shape == () and bool(0 <= found < np.inf)
        require(proper, f"{name} is {shown(found)}: make it one finite number, zero or more")
        way += float(found)
    return way
