"""Two rules that only a recording allows: frames evenly spaced in time, and those that truly show the most."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, Quantity
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import Rule
from jaxnbv.search.problem import Problem


class EvenlySpaced(Rule):
    """The frames that divide the recording evenly, from the first view on and round its end.

    - `views`: into how many parts.
    """

    views: int = eqx.field(static=True, kw_only=True)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Values are 1 for the frame whose turn it is; the key is not used."""
        start = problem.evidence.poses
        apart = [candidates.position - start.position[0], candidates.forward - start.forward[0]]
        first = jnp.argmin(jnp.linalg.norm(jnp.concatenate(apart, axis=-1), axis=-1))
        parts = jnp.round(problem.evidence.num_views * candidates.position.shape[0] / self.views).astype(int)
        turn = (first + parts) % candidates.position.shape[0]
        chosen = jnp.arange(candidates.position.shape[0]) == turn
        return chosen.astype(candidates.position.dtype)


class MostNewVoxels(Rule):
    """The greedy oracle: the frame that truly shows the most voxels that no frame so far has shown.

    - `shown`: which voxels each candidate shows.
    """

    shown: Bool[Array, "candidates voxels"] = eqx.field(kw_only=True)

    def quantity(self, acquisition: Acquisition) -> Quantity:
        return Quantity("new voxels", "", "voxels that a frame shows and no frame before it.", smooth=False)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Values are numbers of voxels; the key is not used."""
        known = jnp.any(self.shown & problem.is_visited(candidates)[:, None], axis=0)
        gain = jnp.sum(self.shown & ~known, axis=1)
        return gain.astype(candidates.position.dtype)
