"""Discrete candidate search (the paper's Algorithm 1), and a variant with a second acquisition."""

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
    """Search that proposes the candidate of the highest acquisition.

    For an acquisition that `gains_once` (`NewSurface`), it proposes among tied candidates the farthest from the cameras
    so far. A candidate is tied if its value is below the best by at most two standard errors of the difference plus the
    mean value expected at visited poses. At these poses the expectation is wrong, and it may be as wrong elsewhere.
    """

    uses_samples: ClassVar[bool] = True

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Propose one of the candidates that are not excluded. The key is not used."""
        return best_or_farthest(problem, candidates, scores[0])


class TieBreakSearch(CandidateSearch):
    """Search for the highest acquisition, in which a second acquisition decides between tied candidates.

    Before any view shows what matters, no sample shows it either, and the argmax is a random view. Candidates are tied
    if their values differ from the best by at most two standard errors of the difference (`Proposal.tied_with_best`).
    So the second acquisition decides at first, and the first one as soon as its values differ. Both score the same
    imagined scans. The proposal has the values of the first acquisition; the proposed one need not be the highest.

    - `second`: acquisition that decides between tied candidates, for example `Coverage()`.
    """

    second: Acquisition = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """Both acquisitions."""
        return acquisition, self.second

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Propose the argmax of the second acquisition over tied candidates. The key is not used."""
        first, second = scores
        proposal = best_unvisited(problem, candidates, jnp.mean(first, axis=0), scores=first)
        return preferred(proposal, jnp.mean(second, axis=0))
