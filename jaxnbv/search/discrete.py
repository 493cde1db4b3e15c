"""Discrete candidate search: the paper's Algorithm 1, and a second question where samples cannot answer the first."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_fields
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import CandidateSearch, Scores, best_or_farthest, best_unvisited, preferred
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class DiscreteSearch(CandidateSearch):
    """The candidate of the highest acquisition.

    Where a pose that was taken has nothing more to give (`NewSurface`), it is the farthest from the cameras so far
    among the candidates that are level with the highest: within two standard errors of the difference, and what is
    expected, on average, of the poses that were taken. There it is expected in vain, and so it may be elsewhere.
    """

    uses_samples: ClassVar[bool] = True

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """One of the candidates not visited yet; the key is not used."""
        return best_or_farthest(problem, candidates, scores[0])


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
        return preferred(found, jnp.mean(second, axis=0))
