"""What a search answers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.display import Displayed
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.travel import CostFunction, arc_length, visiting_order


class Trajectories(eqx.Module):
    """Where a gradient search stood, step by step, from each of its starts to the end, and the values there.

    - `poses`: with the leading axes of `values`; `iterations` + 1 steps.
    """

    poses: Pose
    values: Float[Array, "*starts steps"]

    @property
    def flat(self) -> tuple[Pose, Float[Array, " looks"]]:
        """All poses and values: the starts, then where each went with its first step, and so on."""
        poses, values = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), (self.poses, self.values))
        return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), (poses, values))


class Proposal(Displayed):
    """A search's answer: the pose to take next, and what it looked at.

    - `value`: the chosen pose's value, in the units of what the search maximises.
    - `candidates`, `values`: the pool of poses and their values; -inf where one was excluded as visited.
    - `standard_errors`: of the values, as means over the posterior samples; `difference_errors`: of each value less
      that of the best candidate, which is known better, since all poses are scored on the same samples. NaN for a
      single sample; None for a search that does not score all candidates on all samples.
    - `trajectories`: those of a gradient search, starting from the best candidates; None for other searches.
    """

    pose: Pose
    value: Float[Array, ""]
    candidates: Pose
    values: Float[Array, " candidates"]
    trajectories: Trajectories | None = None
    standard_errors: Float[Array, " candidates"] | None = None
    difference_errors: Float[Array, " candidates"] | None = None

    def is_level(self, errors: float = 2.0) -> Bool[Array, " candidates"] | None:
        """Which candidates the samples cannot tell from the best one, itself included: those whose value is within so
        many standard errors of the difference. None where these are not known."""
        if self.difference_errors is None:
            return None
        best = jnp.max(self.values)
        return (self.values == best) | (best - self.values <= errors * self.difference_errors)

    @property
    def standard_error(self) -> float | None:
        """Of the chosen pose's value; None where it is not known, or the pose is none of the candidates."""
        if self.standard_errors is None:
            return None
        same = jax.tree.map(lambda rows, row: rows == row, self.candidates, self.pose)
        chosen = np.asarray(jnp.all(same.position, axis=1) & jnp.all(same.rotation, axis=(1, 2)))
        return float(self.standard_errors[chosen.argmax()]) if chosen.any() else None

    @property
    def others_level(self) -> int | None:
        """How many other candidates are level with the best one, within two standard errors; None where that is not
        known, as for a single sample."""
        level = self.is_level()
        if level is None or bool(jnp.isnan(jnp.asarray(self.difference_errors)).any()):
            return None
        return int(jnp.sum(level)) - 1


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
