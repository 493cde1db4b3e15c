"""Discrete search that asks a second question where the samples cannot answer the first."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Score, Several
from jaxnbv.checks import check_fields
from jaxnbv.search.base import CandidateSearch, best_unvisited, first_best
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class TieBreakSearch(CandidateSearch):
    """The candidate of the highest acquisition; among those that the samples cannot tell from it, the one of the
    highest second score.

    While nothing was seen of what matters, no sample shows it either, and a classifier or utility finds all views
    alike: their values differ by the noise of a few samples, and the argmax is a view at random. Candidates count as
    level within two standard errors of the difference from the best (`Proposal.is_level`), so that the second score
    decides early, and the first as soon as it tells views apart. Both are asked about the same scans.

    - `second`: decides between level candidates, such as `Coverage()`.

    Values of its proposals are the acquisition's; the chosen one need not be the highest.
    """

    second: Score = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The argmax of the second score over the level candidates not visited yet; the key is not used."""
        candidates = self.candidates.poses()
        first, second = problem.about(Several((problem.score, self.second))).scores(candidates)
        found = best_unvisited(problem, candidates, jnp.mean(first, axis=0), scores=first)
        level = found.is_level()
        assert level is not None
        seconds = jnp.where(level & (found.values > -jnp.inf), jnp.mean(second, axis=0), -jnp.inf)
        index = first_best(seconds)
        # What is not a number is told of by the planner, whichever score gave it.
        value = jnp.where(jnp.isnan(seconds[index]), jnp.nan, found.values[index])
        value = jnp.where(jnp.isfinite(found.value), value, found.value)
        return dataclasses.replace(found, pose=candidates[index], value=value)
