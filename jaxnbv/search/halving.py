"""Successive halving, a discrete search that scores poor candidates on a few samples only."""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import CandidateSearch, Scores
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal

# Smallest number of candidates that are scored together, and the rank that marks an unused entry of a `_Block`.
_MIN_BLOCK_SIZE = 8
_NO_RANK = np.iinfo(np.int32).max


class HalvingSearch(CandidateSearch):
    """Successive halving over candidates (Karnin et al. 2013), a faster `DiscreteSearch`.

    All candidates are scored on the first few posterior samples. Each later round keeps the better half of the
    candidates, and doubles the number of samples on which they are scored, until all samples are used. For 16 samples
    and `num_first_samples=2`, a candidate is scored on 5 samples on average. The result may differ from that of
    `DiscreteSearch`.

    - `num_first_samples`: number of posterior samples on which every candidate is scored.
    """

    num_first_samples: int = eqx.field(static=True, default=2)
    uses_samples: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(self.num_first_samples >= 1, f"num_first_samples is {self.num_first_samples}; it must be at least 1")

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        candidates = self.candidates.poses()

        def score(rows: Int[Array, " rows"], sample: Int[Array, ""]) -> Float[Array, " rows"]:
            return problem.scores(candidates[rows], sample[None])[0]

        return self._halve(problem, candidates, score)

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Propose the best candidate of the last round. A candidate dropped earlier keeps its value from then."""
        return self._halve(problem, candidates, lambda rows, sample: scores[0, sample][rows])

    def _halve(self, problem: Problem, candidates: Pose, score: Callable) -> Proposal:
        count, is_excluded = self.candidates.count, problem.is_excluded(candidates)
        zeros = jnp.zeros(count, candidates.position.dtype)

        def rank(state, num_left):
            """Return `order` with its first `num_left` candidates sorted by mean score, and all mean scores."""
            order, totals, num_scored = state
            values = jnp.where(is_excluded, -jnp.inf, totals / jnp.maximum(num_scored, 1))
            ranked_values = jnp.where(jnp.arange(count) < num_left, values[order], -jnp.inf)
            return order[jnp.argsort(-ranked_values, stable=True)], values

        def advance(carry, block):
            state, squares = carry
            order, totals, num_scored = state
            order = jax.lax.cond(block.sorts, lambda: rank(state, block.num_left)[0], lambda: order)
            indices = order.at[block.ranks].get(mode="fill", fill_value=0)
            rows = jnp.where(block.ranks < count, indices, count)
            scores, num_before = score(indices, block.sample), num_scored[indices]
            # Update the squared deviations from the mean by one sample (Welford 1962).
            deviation = scores - totals[indices] / jnp.maximum(num_before, 1)
            squares = squares.at[rows].add(deviation**2 * num_before / (num_before + 1), mode="drop")
            totals = totals.at[rows].add(scores, mode="drop")
            return ((order, totals, num_scored.at[rows].add(1, mode="drop")), squares), None

        blocks, num_left = self._blocks(problem.num_samples)
        start = (jnp.arange(count), zeros, zeros), zeros
        (state, squares), _ = jax.lax.scan(advance, start, blocks)
        order, values = rank(state, num_left)
        num_scored, best = state[2], order[0]
        errors = jnp.where(num_scored > 1, jnp.sqrt(squares / (jnp.maximum(num_scored - 1, 1) * num_scored)), jnp.nan)
        return Proposal(
            candidates[best], values[best], candidates, values, standard_error=errors[best], standard_errors=errors
        )

    def _blocks(self, num_samples: int) -> tuple["_Block", int]:
        """Return the equal-sized blocks of all rounds, and the number of candidates in the last round."""
        rounds: list[tuple[int, range]] = []
        num_left, num_scored = self.candidates.count, 0
        while num_scored < num_samples:
            num_left = max(1, num_left // 2) if num_scored else num_left
            end = min(2 * num_scored if num_scored else self.num_first_samples, num_samples)
            rounds.append((num_left, range(num_scored, end)))
            num_scored = end
        size = max(num_left, min(_MIN_BLOCK_SIZE, self.candidates.count))
        num_ranked, blocks = self.candidates.count, []
        for num_left, samples in rounds:
            for sample in samples:
                for start in range(0, num_left, size):
                    ranks = np.arange(start, start + size)
                    sorts = start == 0 and 0 < sample == samples[0]
                    blocks.append((sorts, num_ranked, sample, np.where(ranks < num_left, ranks, _NO_RANK)))
            num_ranked = num_left
        return _Block(*map(np.stack, zip(*blocks, strict=True))), num_left


class _Block(NamedTuple):
    """Candidates that are scored together on one posterior sample. `_blocks` stacks several blocks.

    - `sorts`: whether to sort the candidates of the previous round by mean score before this block is scored.
    - `num_left`: number of candidates of the previous round. In the first round, the number of all candidates.
    - `sample`: index of the posterior sample.
    - `ranks`: positions, in the sorted order, of the candidates to score; `_NO_RANK` for an unused entry.
    """

    sorts: Bool[np.ndarray, "*blocks"]
    num_left: Int[np.ndarray, "*blocks"]
    sample: Int[np.ndarray, "*blocks"]
    ranks: Int[np.ndarray, "*blocks size"]
