"""Discrete search over candidates (the paper's Algorithm 1), and a variant with two acquisitions."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import check_fields
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import CandidateSearch, Scores, best_unvisited, preferred
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class DiscreteSearch(CandidateSearch):
    """Search that proposes the candidate of the highest value.

    If a second view from the same pose gains nothing (`Acquisition.gains_once`, as for `NewSurface`), and moves have no
    cost, it proposes the tied candidate that is farthest from the earlier cameras. A candidate is tied if its value
    differs from the best by at most two standard errors of the difference, plus the mean value estimated at the poses
    of the latest eight views. The true value at visited poses is zero, so this mean shows how large errors may be at
    other poses.
    """

    uses_samples: ClassVar[bool] = True

    def score(self, problem: Problem, candidates: Pose) -> Scores:
        """Return the scores of the candidates, followed by those of the latest poses if `pick` needs them.

        The latest poses are scanned together with the candidates, because a scan of their own would be compiled too.
        """
        if problem.distance_breaks_ties:
            candidates = jax.tree.map(lambda *rows: jnp.concatenate(rows), candidates, problem.latest_poses)
        return super().score(problem, candidates)

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        count = len(candidates.position)
        scores, at_latest = scores[0, :, :count], scores[0, :, count:]
        proposal = best_unvisited(problem, candidates, jnp.mean(scores, axis=0), scores=scores)
        if not problem.distance_breaks_ties:
            return proposal
        proposal = dataclasses.replace(proposal, value_at_visited=problem.value_at_visited(at_latest))
        visited_poses = problem.observations.poses
        # Without earlier cameras all distances are infinite, so the candidate of the highest value is preferred.
        preference = jnp.where(visited_poses.count > 0, visited_poses.distance(candidates), proposal.values)
        return preferred(proposal, preference)


class TieBreakSearch(CandidateSearch):
    """Search with two acquisitions, where the second decides between candidates that tie in the first.

    Until a view has shown the relevant part of the object, the samples do not contain it either. The values of the
    first acquisition are then mostly noise, and their maximum is a random view. A candidate is tied if its value
    differs from the best by at most two standard errors of the difference (`Proposal.tied_with_best`). So the second
    acquisition decides in the first steps. The first acquisition decides once its values differ by more than noise.

    Both acquisitions score the same simulated scans. The proposal contains the values of the first acquisition.

    - `second`: acquisition that decides between tied candidates, for example `Coverage()`.
    """

    second: Acquisition = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        return acquisition, self.second

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        first, second = scores
        proposal = best_unvisited(problem, candidates, jnp.mean(first, axis=0), scores=first)
        return preferred(proposal, jnp.mean(second, axis=0))
