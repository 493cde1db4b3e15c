"""Discrete search that spends its samples where they matter."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.checks import check_fields, require
from jaxnbv.search.base import CandidateSearch
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class HalvingSearch(CandidateSearch):
    """Successive halving over the candidates of a `DiscreteSearch` (Karnin et al. 2013), for scores that are slow.

    All candidates are scored on the first few posterior samples; the better half on as many again, the better half of
    these on twice as many, and so on to all S: with 16 samples and `first_samples` 2, 5 scores a candidate in place of
    16. Samples are the same for all candidates (common random numbers), so what is compared are differences between
    poses on the same surfaces. The view is not always that of the full search.

    - `first_samples`: posterior samples on which every candidate is scored.
    """

    first_samples: int = eqx.field(static=True, default=2)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(self.first_samples >= 1, f"first_samples is {self.first_samples}; candidates need at least one")

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The best of the last round; the value of a candidate that left earlier is its mean until then."""
        candidates = self.candidates.poses()
        is_closed = problem.is_closed(candidates)
        left = jnp.arange(self.candidates.count)
        totals = jnp.zeros(self.candidates.count, candidates.position.dtype)
        values, scored = totals, 0
        while scored < problem.num_samples:
            if scored:
                left = left[jax.lax.top_k(values[left], max(1, len(left) // 2))[1]]
            more = min(max(scored, self.first_samples), problem.num_samples - scored)
            means = problem.acquisition(candidates[left], slice(scored, scored + more))
            totals, scored = totals.at[left].add(more * means), scored + more
            values = values.at[left].set(jnp.where(is_closed[left], -jnp.inf, totals[left] / scored))
        best = left[jnp.argmax(values[left])]
        return Proposal(candidates[best], values[best], candidates, values)
