"""What a search answers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.pose import Pose


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


class Proposal(eqx.Module):
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

    def tied_with_best(self, errors: float = 2.0) -> Bool[Array, " candidates"] | None:
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
    def num_tied(self) -> int | None:
        """How many other candidates are tied with the best one; None where that is not known."""
        tied = self.tied_with_best()
        if tied is None or bool(jnp.isnan(jnp.asarray(self.difference_errors)).any()):
            return None
        return int(jnp.sum(tied)) - 1
