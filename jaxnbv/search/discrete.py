"""Discrete candidate search: the paper's Algorithm 1."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import PRNGKeyArray

from jaxnbv.search.base import (
    SENSOR_RADIUS,
    Problem,
    Proposal,
    Search,
    best_unvisited,
    check_candidates,
    sphere_candidates,
)


class DiscreteSearch(Search):
    """The candidate of the highest acquisition, among `num_candidates` on a Fibonacci sphere of the given radius."""

    num_candidates: int = eqx.field(static=True, default=120)
    radius: float = eqx.field(static=True, default=SENSOR_RADIUS)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_candidates(self.num_candidates, self.radius)

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The argmax of the acquisition over the candidates not visited yet; the key is not used."""
        candidates = sphere_candidates(self.num_candidates, self.radius)
        return best_unvisited(problem, candidates, problem.acquisition(candidates))
