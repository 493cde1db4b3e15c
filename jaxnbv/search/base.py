"""Base classes of searches, and functions that choose the best candidate."""

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

# mypy cannot see that a converter also accepts numbers and poses.
if TYPE_CHECKING:
    AnyCandidates: TypeAlias = Any
else:
    AnyCandidates = Candidates

Scores: TypeAlias = Float[Array, "acquisitions samples candidates"]
"""Score of each candidate on each posterior sample, for each acquisition of `CandidateSearch.acquisitions`."""

_TIE = 1e-5


class Search(eqx.Module):
    """Base class of searches, which find the next pose.

    - `uses_samples`: whether the search needs posterior samples.
    - `uses_cost`: whether the search can include the cost of the move in the value of a pose.
    """

    uses_samples: eqx.AbstractClassVar[bool]
    uses_cost: ClassVar[bool] = True

    def check(self, acquisition: Acquisition, camera: Camera, capacity: int) -> None:
        """Raise `ValueError` if the search cannot work with this acquisition, camera and cloud capacity."""
        return

    def quantity(self, acquisition: Acquisition) -> Quantity:
        """Return the name, unit and meaning of the maximised values, by default those of the acquisition."""
        return acquisition.quantity

    def poses_around(self) -> Pose:
        """Return poses around the object. `Covered` counts surface as visible if one of these poses sees it."""
        return SphereCandidates().poses()

    def upper_half(self) -> "Search":
        """Return a copy with as many candidates, on the upper half of the sphere only.

        A search whose candidates are not a whole sphere is returned unchanged.
        """
        return self

    def over(self, poses: Pose) -> "Search":
        """Return a copy whose candidates are `poses`, a batch (n,).

        **Raises:** `ValueError` if the search has no candidates to replace.
        """
        raise InputError(
            f"poses were given, but {type(self).__name__} is no search over candidates: use DiscreteSearch() or "
            "HalvingSearch()"
        )

    @abstractmethod
    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """Propose the next pose. This must be a pure function that runs under `jit`."""


class CandidateSearch(Search):
    """Base class of searches that score all candidates, then pick one of them.

    A study can compute the scores of `acquisitions` once, and pass them to `pick` of several searches.

    - `candidates`: `Candidates`, a number of `SphereCandidates`, or a batch of poses.
    """

    candidates: AnyCandidates = eqx.field(converter=as_candidates, default=SphereCandidates())

    def poses_around(self) -> Pose:
        return self.candidates.poses()

    def upper_half(self) -> "CandidateSearch":
        return dataclasses.replace(self, candidates=self.candidates.upper_half())

    def over(self, poses: Pose) -> "CandidateSearch":
        return dataclasses.replace(self, candidates=GivenPoses(poses))

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        """Return the acquisitions whose scores `pick` needs. The tuple is empty if `pick` needs no scores."""
        return (acquisition,)

    def score(self, problem: Problem, candidates: Pose) -> Scores:
        """Return the scores that `pick` needs, one for each acquisition, sample and candidate."""
        acquisitions = self.acquisitions(problem.acquisition)
        if not acquisitions:
            return jnp.zeros((0, 0, self.candidates.count))
        if len(acquisitions) == 1:
            return problem.scores(candidates)[None]
        return problem.with_acquisition(AcquisitionList(acquisitions)).scores(candidates)

    @abstractmethod
    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """Propose a candidate, given the result of `score`. The key is for searches with random choices."""

    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        candidates = self.candidates.poses()
        return self.pick(problem, candidates, self.score(problem, candidates), key)


class Baseline(CandidateSearch):
    """Base class of searches that compute the value of a candidate without the acquisition."""

    uses_samples: ClassVar[bool] = False
    uses_cost: ClassVar[bool] = False

    def acquisitions(self, acquisition: Acquisition) -> tuple[Acquisition, ...]:
        return ()

    @abstractmethod
    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Return the value of each candidate. The search proposes the best one that is not excluded."""

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        return best_unvisited(problem, candidates, self.values(problem, candidates, key))


def best_unvisited(
    problem: Problem,
    candidates: Pose,
    values: Float[Array, " candidates"],
    tie: float = _TIE,
    scores: Float[Array, "samples candidates"] | None = None,
) -> Proposal:
    """Propose the candidate with the highest value among those that `problem` does not exclude.

    - `tie`: values within this fraction of the highest value tie with it. The first of the tied candidates is proposed.
      The default exceeds rounding errors.
    - `scores`: scores whose means over the samples are `values`. They determine the proposal's standard errors.
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


def preferred(proposal: Proposal, preference: Float[Array, " candidates"]) -> Proposal:
    """Return a copy that proposes the candidate of highest `preference` among those tied with the best."""
    is_tied, errors = proposal.tied_with_best(), proposal.standard_errors
    assert is_tied is not None
    assert errors is not None
    preference = jnp.where(is_tied & (proposal.values > -jnp.inf), preference, -jnp.inf)
    index = first_best(preference)
    # NaN in a preference or value propagates to the proposal, and the planner reports it.
    value = jnp.where(jnp.isnan(preference[index]), jnp.nan, proposal.values[index])
    value = jnp.where(jnp.isfinite(proposal.value), value, proposal.value)
    return dataclasses.replace(proposal, pose=proposal.candidates[index], value=value, standard_error=errors[index])


def first_best(values: Float[Array, " candidates"], tie: float = _TIE) -> Int[Array, ""]:
    """Return the first index whose value is within the relative difference `tie` of the highest value."""
    best = jnp.max(values)
    # No value ties with an infinite value. The planner reports NaN.
    is_tied = values >= best - jnp.where(jnp.isfinite(best), tie * jnp.abs(best), 0.0)
    return jnp.where(jnp.isfinite(best), jnp.argmax(is_tied), jnp.argmax(values))


def standard_error(scores: Float[Array, "samples *poses"]) -> Float[Array, "*poses"]:
    """Return the standard error of the mean over samples; NaN for one sample."""
    count = scores.shape[0]
    squares = jnp.sum((scores - jnp.mean(scores, axis=0)) ** 2, axis=0)
    return jnp.sqrt(squares / (count - 1) / count) if count > 1 else jnp.full(scores.shape[1:], jnp.nan)
