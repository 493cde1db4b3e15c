"""How a pose is found: what all searches have in common."""

import dataclasses
from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, AcquisitionList
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.candidates import Candidates, GivenPoses, SphereCandidates, as_candidates
from jaxnbv.search.problem import Problem
from jaxnbv.search.proposal import Proposal
from jaxnbv.utility import Quantity

# Numbers and poses are converted on the way in, which mypy cannot see.
if TYPE_CHECKING:
    AnyCandidates: TypeAlias = Any
else:
    AnyCandidates = Candidates

Scores: TypeAlias = Float[Array, "asked samples candidates"]
"""Of the acquisitions that a search asks, of each posterior sample, at each candidate."""

_TIE = 1e-5


class Search(eqx.Module):
    """How a pose is found. `uses_samples` says whether posterior samples must be drawn for it, `uses_cost` whether
    the cost of going there can count."""

    uses_samples: eqx.AbstractClassVar[bool]
    uses_cost: ClassVar[bool] = True

    def check(self, acquisition: Acquisition, camera: Camera, capacity: int) -> None:
        """Raise `ValueError` if the search cannot work with an acquisition, a camera and a cloud of so many rows."""
        return

    def quantity(self, acquisition: Acquisition) -> Quantity:
        """What the values of its proposals are: by default the acquisition's."""
        return acquisition.quantity

    def poses_around(self) -> Pose:
        """Poses all about the object, for questions about all that can be seen of it: by default the paper's."""
        return SphereCandidates().poses()

    def above(self) -> "Search":
        """The search over the upper half of its poses, where these are the whole sphere."""
        return self

    def among(self, poses: Pose) -> "Search":
        """The search over given poses (n,).

        **Raises:** `ValueError` if the search does not choose among poses.
        """
        raise InputError(
            f"poses were given, but {type(self).__name__} is no search over candidates: use DiscreteSearch() or "
            "HalvingSearch()"
        )

    @abstractmethod
    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The pose to take next; a pure function of its arguments, which runs under `jit`."""


class CandidateSearch(Search):
    """A search that chooses one of its candidates, in two halves: it scores them, then it picks.

    A study gives several searches the same scores, those of `asks`, and lets each `pick`.

    - `candidates`: `SphereCandidates`, `GivenPoses` or others; a number stands for so many on the paper's sphere, and a
      batch of poses for these.
    """

    candidates: AnyCandidates = eqx.field(converter=as_candidates, default=SphereCandidates())

    def poses_around(self) -> Pose:
        """Its candidates."""
        return self.candidates.poses()

    def above(self) -> "CandidateSearch":
        return dataclasses.replace(self, candidates=self.candidates.above())

    def among(self, poses: Pose) -> "CandidateSearch":
        return dataclasses.replace(self, candidates=GivenPoses(poses))

    def asks(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """The acquisitions whose scores it picks by; none for a search that does not look at them."""
        return (acquisition,)

    def score(self, problem: Problem, candidates: Pose) -> Scores:
        """The first half: the scores of the candidates, sample by sample, by each acquisition that it asks."""
        asked = self.asks(problem.acquisition)
        if not asked:
            return jnp.zeros((0, 0, self.candidates.count))
        if len(asked) == 1:
            return problem.scores(candidates)[None]
        return problem.about(AcquisitionList(asked)).scores(candidates)

    @abstractmethod
    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The second half: one of the candidates, given their scores."""

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """Score, then pick."""
        candidates = self.candidates.poses()
        return self.pick(problem, candidates, self.score(problem, candidates), key)


class Baseline(CandidateSearch):
    """A search that values candidates by itself, whatever the acquisition."""

    uses_samples: ClassVar[bool] = False
    uses_cost: ClassVar[bool] = False

    def asks(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """None."""
        return ()

    @abstractmethod
    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Of each candidate; the open one of the highest value is taken."""

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The argmax of `values`; there are no scores."""
        return best_unvisited(problem, candidates, self.values(problem, candidates, key))


def best_unvisited(
    problem: Problem,
    candidates: Pose,
    values: Float[Array, " candidates"],
    tie: float = _TIE,
    scores: Float[Array, "samples candidates"] | None = None,
) -> Proposal:
    """The candidate of the highest value among those that are open; the first of them where values tie.

    `tie`: the relative difference within which they do, by default what sums in another order differ by. `scores`:
    those whose means the values are, for their standard errors.
    """
    values = jnp.where(problem.is_excluded(candidates), -jnp.inf, values)
    index = first_best(values, tie)
    found = Proposal(candidates[index], values[index], candidates, values)
    if scores is None:
        return found
    errors, of_differences = standard_error(scores), standard_error(scores - scores[:, index][:, None])
    return dataclasses.replace(
        found, standard_error=errors[index], standard_errors=errors, difference_errors=of_differences
    )


def best_or_farthest(problem: Problem, candidates: Pose, scores: Float[Array, "samples candidates"]) -> Proposal:
    """`best_unvisited`; of an acquisition that `gains_once`, the farthest from the cameras so far among the candidates
    that are level with it, unless a cost counts, which would speak against it."""
    found = best_unvisited(problem, candidates, jnp.mean(scores, axis=0), scores=scores)
    if not problem.acquisition.gains_once or problem.cost is not None:
        return found
    found = dataclasses.replace(found, in_vain=problem.expected_in_vain())
    taken = problem.observations.poses
    # From no pose, all are equally far.
    return preferred(found, jnp.where(taken.count > 0, taken.distance(candidates), found.values))


def preferred(found: Proposal, preference: Float[Array, " candidates"]) -> Proposal:
    """A proposal with the candidate of the highest preference among those that are level with its best and open."""
    tied, errors = found.tied_with_best(), found.standard_errors
    assert tied is not None
    assert errors is not None
    preference = jnp.where(tied & (found.values > -jnp.inf), preference, -jnp.inf)
    index = first_best(preference)
    # NaN in either propagates; the planner reports it.
    value = jnp.where(jnp.isnan(preference[index]), jnp.nan, found.values[index])
    value = jnp.where(jnp.isfinite(found.value), value, found.value)
    return dataclasses.replace(found, pose=found.candidates[index], value=value, standard_error=errors[index])


def first_best(values: Float[Array, " candidates"], tie: float = _TIE) -> Int[Array, ""]:
    """Index of the highest value, ties as of `best_unvisited`."""
    best = jnp.max(values)
    # Nothing ties with an infinite value, and the planner reports NaN.
    tied = values >= best - jnp.where(jnp.isfinite(best), tie * jnp.abs(best), 0.0)
    return jnp.where(jnp.isfinite(best), jnp.argmax(tied), jnp.argmax(values))


def standard_error(scores: Float[Array, "samples *poses"]) -> Float[Array, "*poses"]:
    """Standard error of the mean over samples; NaN for one sample."""
    count = scores.shape[0]
    squares = jnp.sum((scores - jnp.mean(scores, axis=0)) ** 2, axis=0)
    return jnp.sqrt(squares / (count - 1) / count) if count > 1 else jnp.full(scores.shape[1:], jnp.nan)
