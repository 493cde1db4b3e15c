"""Discrete candidate search: the paper's Algorithm 1."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxnbv.search.base import CandidateSearch, best_unvisited
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal


class DiscreteSearch(CandidateSearch):
    """The candidate of the highest acquisition."""

    uses_samples: ClassVar[bool] = True

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The argmax of the acquisition over the candidates not visited yet; the key is not used."""
        candidates = self.candidates.poses()
        scores = problem.scores(candidates)
        return best_unvisited(problem, candidates, jnp.mean(scores, axis=0), scores=scores)
