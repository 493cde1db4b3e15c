"""Discrete search over candidates (the paper's Algorithm 1), and a variant with a second acquisition."""

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
    """Search that proposes the candidate of the highest value.

    With an acquisition for which a second view from the same pose gains nothing (`gains_once`), such as `NewSurface`,
    several candidates may be tied with the best. The search then proposes the tied candidate that is farthest from the
    earlier cameras. A candidate is tied if its value differs from the best by at most two standard errors of the
    difference, plus the mean value expected at visited poses. The true value at visited poses is zero, so this mean is
    an error, and may be as large at other poses.
    """

    uses_samples: ClassVar[bool] = True

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Propose the best candidate that is not excluded, or one tied with it. The random key is not used."""
        return best_or_farthest(problem, candidates, scores[0])


class TieBreakSearch(CandidateSearch):
    """Search with two acquisitions, in which the second decides between candidates that tie in the first.

    Until a view has shown the relevant part of the object, the samples do not contain it either. The values of the
    first acquisition are then mostly noise, and their maximum is a random view. Candidates are tied if their values
    differ from the best by at most two standard errors of the difference (`Proposal.tied_with_best`). Therefore the
    second acquisition decides in the first steps, and the first acquisition decides as soon as its values differ.

    Both acquisitions score the same simulated scans. The proposal contains the values of the first acquisition, and the
    proposed pose need not have the highest of these values.

    - `second`: acquisition that decides between tied candidates, for example `Coverage()`.
    """

    second: Acquisition = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """Return both acquisitions."""
        return acquisition, self.second

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Propose the tied candidate with the highest value of the second acquisition. The key is not used."""
        first, second = scores
        proposal = best_unvisited(problem, candidates, jnp.mean(first, axis=0), scores=first)
        return preferred(proposal, jnp.mean(second, axis=0))
