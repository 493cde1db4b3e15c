"""Discrete candidate search: the paper's Algorithm 1, and a second question where samples cannot answer the first."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_fields
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import CandidateSearch, Scores, best_unvisited, first_best
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class DiscreteSearch(CandidateSearch):
    """The candidate of the highest acquisition."""

    uses_samples: ClassVar[bool] = True

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The argmax of the acquisition over the candidates not visited yet; the key is not used."""
        return best_unvisited(problem, candidates, jnp.mean(scores[0], axis=0), scores=scores[0])


class TieBreakSearch(CandidateSearch):
    """The candidate of the highest acquisition; among those that the samples cannot tell from it, the one of the
    highest second acquisition.

    While nothing was seen of what matters, no sample shows it either, and the argmax is a view at random. Candidates
    count as tied within two standard errors of the difference from the best (`Proposal.tied_with_best`), so that the
    second decides early, and the first as soon as it tells views apart. Both are asked about the same scans.

    - `second`: decides between tied candidates, such as `Coverage()`.

    Values of its proposals are the acquisition's; the chosen one need not be the highest.
    """

    second: Acquisition = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)

    def asks(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """Both."""
        return acquisition, self.second

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The argmax of the second acquisition over the tied candidates not visited yet; the key is not used."""
        first, second = scores
        found = best_unvisited(problem, candidates, jnp.mean(first, axis=0), scores=first)
        tied = found.tied_with_best()
        assert tied is not None
        seconds = jnp.where(tied & (found.values > -jnp.inf), jnp.mean(second, axis=0), -jnp.inf)
        index = first_best(seconds)
        # NaN from either acquisition propagates; the planner reports it.
        value = jnp.where(jnp.isnan(seconds[index]), jnp.nan, found.values[index])
        value = jnp.where(jnp.isfinite(found.value), value, found.value)
        assert found.standard_errors is not None
        error = found.standard_errors[index]
        return dataclasses.replace(found, pose=candidates[index], value=value, standard_error=error)
