"""Discrete search that spends its samples where they matter."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import CandidateSearch, Scores
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class HalvingSearch(CandidateSearch):
    """Successive halving over the candidates of a `DiscreteSearch` (Karnin et al. 2013), for slow acquisitions.

    All candidates are scored on the first few posterior samples; the better half on as many again, the better half of
    these on twice as many, and so on to all S: with 16 samples and `num_first_samples` 2, 5 scores a candidate in place
    of 16. Samples are the same for all candidates (common random numbers), so what is compared are differences between
    poses on the same surfaces. The view is not always that of the full search.

    - `num_first_samples`: posterior samples on which every candidate is scored.
    """

    num_first_samples: int = eqx.field(static=True, default=2)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(
            self.num_first_samples >= 1, f"num_first_samples is {self.num_first_samples}; candidates need at least one"
        )

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """As `pick`, but candidates are scored only for as long as they are left."""
        candidates = self.candidates.poses()

        def means(left: Int[Array, " left"], samples: slice) -> Float[Array, " left"]:
            return problem.values(candidates[left], samples)

        return self._halved(problem, candidates, means)

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The best of the last round; the value of a candidate that left earlier is its mean until then."""
        return self._halved(problem, candidates, lambda left, samples: jnp.mean(scores[0, samples][:, left], axis=0))

    def _halved(self, problem: Problem, candidates: Pose, means_of: Callable) -> Proposal:
        is_closed = problem.is_closed(candidates)
        left = jnp.arange(self.candidates.count)
        totals = jnp.zeros(self.candidates.count, candidates.position.dtype)
        values, scored = totals, 0
        while scored < problem.num_samples:
            if scored:
                left = left[jax.lax.top_k(values[left], max(1, len(left) // 2))[1]]
            more = min(max(scored, self.num_first_samples), problem.num_samples - scored)
            means = means_of(left, slice(scored, scored + more))
            totals, scored = totals.at[left].add(more * means), scored + more
            values = values.at[left].set(jnp.where(is_closed[left], -jnp.inf, totals[left] / scored))
        best = left[jnp.argmax(values[left])]
        return Proposal(candidates[best], values[best], candidates, values)
