"""Discrete candidate search: the paper's Algorithm 1."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import CandidateSearch, Scores, best_unvisited
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class DiscreteSearch(CandidateSearch):
    """The candidate of the highest acquisition."""

    uses_samples: ClassVar[bool] = True

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The argmax of the acquisition over the candidates not visited yet; the key is not used."""
        return best_unvisited(problem, candidates, jnp.mean(scores[0], axis=0), scores=scores[0])
