"""What a search answers."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.frame import Frame
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

    - `value`: the chosen pose's value, in the units of what the search maximises; `standard_error`: of it, as a mean
      over the posterior samples. NaN for a single sample; None for a search that does not score on samples.
    - `candidates`, `values`: the pool of poses and their values; -inf where one was excluded as visited.
    - `standard_errors`: of the values, each as a mean over the samples that its candidate was scored on;
      `difference_errors`: of each value less that of the best candidate, which are smaller, since all poses are scored
      on the same samples; None for a search that does not score all candidates on all samples.
    - `trajectories`: those of a gradient search, starting from the best candidates; None for other searches.
    - `in_vain`: what the acquisition expects, on average, of poses that were taken, see `Problem.expected_in_vain`;
      None for an acquisition that may gain twice.
    """

    pose: Pose
    value: Float[Array, ""]
    candidates: Pose
    values: Float[Array, " candidates"]
    trajectories: Trajectories | None = None
    standard_errors: Float[Array, " candidates"] | None = None
    difference_errors: Float[Array, " candidates"] | None = None
    standard_error: Float[Array, ""] | None = None
    in_vain: Float[Array, ""] | None = None

    def in_world(self, frame: Frame, length_power: int) -> "Proposal":
        """The proposal with its values, a power of length, and their errors in world units; poses stay in the scene."""

        def convert(leaf):
            return leaf if isinstance(leaf, Pose) else frame.length_to_world(leaf, length_power)

        return jax.tree.map(convert, self, is_leaf=lambda leaf: isinstance(leaf, Pose))

    def tied_with_best(self, errors: float = 2.0) -> Bool[Array, " candidates"] | None:
        """Which candidates cannot be told from the best one, itself included: those whose value is within so many
        standard errors of the difference, and what is expected in vain. None where the errors are not known."""
        if self.difference_errors is None:
            return None
        best, in_vain = jnp.max(self.values), 0.0 if self.in_vain is None else self.in_vain
        return (self.values == best) | (best - self.values <= errors * self.difference_errors + in_vain)

    @property
    def num_tied(self) -> int | None:
        """How many other candidates are tied with the best one; None where that is not known."""
        tied = self.tied_with_best()
        if tied is None or bool(jnp.isnan(jnp.asarray(self.difference_errors)).any()):
            return None
        return int(jnp.sum(tied)) - 1
