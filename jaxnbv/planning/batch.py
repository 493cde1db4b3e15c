"""Several views to be taken before the planner is asked again."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.travel import CostFunction, arc_length, visiting_order
from jaxnbv.search import Proposal


class Batch(eqx.Module):
    """Several views to be taken before the planner is asked again.

    - `proposals`: in the order in which they were chosen; the value of each is what it adds to those before it.
    - `start`: the last pose so far, None where it is not known; `cost`: what it costs to go from pose to pose.
    """

    proposals: tuple[Proposal, ...]
    start: Pose | None
    cost: CostFunction = arc_length

    @property
    def poses(self) -> Pose:
        """The poses (k,), in the order in which they were chosen."""
        return jax.tree.map(lambda *rows: jnp.stack(rows), *(proposal.pose for proposal in self.proposals))

    @property
    def order(self) -> tuple[int, ...]:
        """The order in which it costs least to visit them.

        **Raises:** `ValueError` for more than twelve.
        """
        return visiting_order(self.start or self.proposals[0].pose, self.poses, self.cost)
