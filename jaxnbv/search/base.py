"""Base classes of searches, and the choice of the best candidate."""

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
"""Scores of each acquisition in `CandidateSearch.acquisitions`, for each posterior sample and candidate."""

_TIE = 1e-5


class Search(eqx.Module):
    """Base class of searches: methods that find the next pose.

    - `uses_samples`: whether the search needs posterior samples.
    - `uses_cost`: whether the cost of going to a pose can count.
    """

    uses_samples: eqx.AbstractClassVar[bool]
    uses_cost: ClassVar[bool] = True

    def check(self, acquisition: Acquisition, camera: Camera, capacity: int) -> None:
        """Raise `ValueError` if the search cannot work with this acquisition, camera and cloud capacity."""
        return

    def quantity(self, acquisition: Acquisition) -> Quantity:
        """Quantity of the values of its proposals, by default the acquisition's."""
        return acquisition.quantity

    def poses_around(self) -> Pose:
        """Poses all around the object, used to compute which surface is visible. By default the paper's."""
        return SphereCandidates().poses()

    def upper_half(self) -> "Search":
        """A copy over the upper half of its poses if these are a whole sphere; otherwise the search itself."""
        return self

    def over(self, poses: Pose) -> "Search":
        """A copy that chooses among these poses (n,).

        **Raises:** `ValueError` if the search does not choose among poses.
        """
        raise InputError(
            f"poses were given, but {type(self).__name__} is no search over candidates: use DiscreteSearch() or "
            "HalvingSearch()"
        )

    @abstractmethod
    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """Propose the next pose. A pure function that runs under `jit`."""


class CandidateSearch(Search):
    """Base class of searches over candidates, in two halves: score the candidates, then pick one.

    A study computes the scores of `acquisitions` once for several searches, and lets each of them `pick`.

    - `candidates`: `SphereCandidates`, `GivenPoses` or others. A number becomes `SphereCandidates`, a batch of poses
      `GivenPoses`.
    """

    candidates: AnyCandidates = eqx.field(converter=as_candidates, default=SphereCandidates())

    def poses_around(self) -> Pose:
        """The poses of its candidates."""
        return self.candidates.poses()

    def upper_half(self) -> "CandidateSearch":
        return dataclasses.replace(self, candidates=self.candidates.upper_half())

    def over(self, poses: Pose) -> "CandidateSearch":
        return dataclasses.replace(self, candidates=GivenPoses(poses))

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """The acquisitions whose scores `pick` needs; empty for a search that needs none."""
        return (acquisition,)

    def score(self, problem: Problem, candidates: Pose) -> Scores:
        """First half: the scores of the candidates for each acquisition in `acquisitions` and each sample."""
        acquisitions = self.acquisitions(problem.acquisition)
        if not acquisitions:
            return jnp.zeros((0, 0, self.candidates.count))
        if len(acquisitions) == 1:
            return problem.scores(candidates)[None]
        return problem.with_acquisition(AcquisitionList(acquisitions)).scores(candidates)

    @abstractmethod
    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Second half: propose one of the candidates, given their scores."""

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """Score, then pick."""
        candidates = self.candidates.poses()
        return self.pick(problem, candidates, self.score(problem, candidates), key)


class Baseline(CandidateSearch):
    """Base class of searches that value candidates without the acquisition."""

    uses_samples: ClassVar[bool] = False
    uses_cost: ClassVar[bool] = False

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """No acquisitions."""
        return ()

    @abstractmethod
    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Value of each candidate. The search picks the highest among those that are not excluded."""

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The argmax of `values`. The scores are empty."""
        return best_unvisited(problem, candidates, self.values(problem, candidates, key))


def best_unvisited(
    problem: Problem,
    candidates: Pose,
    values: Float[Array, " candidates"],
    tie: float = _TIE,
    scores: Float[Array, "samples candidates"] | None = None,
) -> Proposal:
    """Propose the candidate of the highest value that is not excluded; the first one if values tie.

    - `tie`: values tie within this relative difference, by default the rounding error of sums in another order.
    - `scores`: scores whose means are the values, for standard errors.
    """
    values = jnp.where(problem.is_excluded(candidates), -jnp.inf, values)
    index = first_best(values, tie)
    proposal = Proposal(candidates[index], values[index], candidates, values)
    if scores is None:
        return proposal
    errors, difference_errors = standard_error(scores), standard_error(scores - scores[:, index][:, None])
    return dataclasses.replace(
        proposal, standard_error=errors[index], standard_errors=errors, difference_errors=difference_errors
    )


def best_or_farthest(problem: Problem, candidates: Pose, scores: Float[Array, "samples candidates"]) -> Proposal:
    """Propose as `best_unvisited`, but take the farthest of the tied candidates from earlier cameras.

    This applies if the acquisition `gains_once` and no cost counts, since a cost counts against far candidates.
    """
    proposal = best_unvisited(problem, candidates, jnp.mean(scores, axis=0), scores=scores)
    if not problem.acquisition.gains_once or problem.cost is not None:
        return proposal
    proposal = dataclasses.replace(proposal, value_at_visited=problem.value_at_visited())
    visited = problem.observations.poses
    # Without earlier cameras there is no distance: prefer the highest value.
    return preferred(proposal, jnp.where(visited.count > 0, visited.distance(candidates), proposal.values))


def preferred(proposal: Proposal, preference: Float[Array, " candidates"]) -> Proposal:
    """Change a proposal to the most preferred candidate that is tied with its best and not excluded."""
    tied, errors = proposal.tied_with_best(), proposal.standard_errors
    assert tied is not None
    assert errors is not None
    preference = jnp.where(tied & (proposal.values > -jnp.inf), preference, -jnp.inf)
    index = first_best(preference)
    # NaN in either propagates; the planner reports it.
    value = jnp.where(jnp.isnan(preference[index]), jnp.nan, proposal.values[index])
    value = jnp.where(jnp.isfinite(proposal.value), value, proposal.value)
    return dataclasses.replace(proposal, pose=proposal.candidates[index], value=value, standard_error=errors[index])


def first_best(values: Float[Array, " candidates"], tie: float = _TIE) -> Int[Array, ""]:
    """Index of the highest value; the first one within the relative difference `tie`."""
    best = jnp.max(values)
    # Nothing ties with an infinite value, and the planner reports NaN.
    tied = values >= best - jnp.where(jnp.isfinite(best), tie * jnp.abs(best), 0.0)
    return jnp.where(jnp.isfinite(best), jnp.argmax(tied), jnp.argmax(values))


def standard_error(scores: Float[Array, "samples *poses"]) -> Float[Array, "*poses"]:
    """Standard error of the mean over samples; NaN for one sample."""
    count = scores.shape[0]
    squares = jnp.sum((scores - jnp.mean(scores, axis=0)) ** 2, axis=0)
    return jnp.sqrt(squares / (count - 1) / count) if count > 1 else jnp.full(scores.shape[1:], jnp.nan)
