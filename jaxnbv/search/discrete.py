"""Discrete candidate search: the paper's Algorithm 1."""

from typing import ClassVar

from jaxtyping import PRNGKeyArray

from jaxnbv.search.base import CandidateSearch, Problem, Proposal, best_unvisited


class DiscreteSearch(CandidateSearch):
    """The candidate of the highest acquisition."""

    uses_samples: ClassVar[bool] = True

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The argmax of the acquisition over the candidates not visited yet; the key is not used."""
        candidates = self.candidates.poses()
        return best_unvisited(problem, candidates, problem.acquisition(candidates))
