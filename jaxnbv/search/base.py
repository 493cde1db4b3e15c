"""What a search is asked, and what it answers."""

import dataclasses
from abc import abstractmethod
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.acquisition import Score, sample_scores
from jaxnbv.answers import Quantity
from jaxnbv.camera import Camera
from jaxnbv.checks import InputError
from jaxnbv.cloud import PointCloud
from jaxnbv.pose import Pose
from jaxnbv.scanning import GridSurface
from jaxnbv.search.candidates import Candidates, SphereCandidates, as_candidates

# Numbers and poses are converted on the way in, which mypy cannot see.
if TYPE_CHECKING:
    AnyCandidates: TypeAlias = Any
else:
    AnyCandidates = Candidates


_TIE = 1e-5


class Problem(eqx.Module):
    """One step's question: where to look next.

    - `cloud`: D, what has been seen.
    - `visited`: the poses taken so far in the first `num_visited` rows; the others hold nothing.
    - `surfaces`: the step's posterior samples along a leading axis; None for a search that does not ask for them.
    - `context`: what the score makes of D, once; None without samples.
    """

    cloud: PointCloud
    visited: Pose
    num_visited: Int[Array, ""]
    camera: Camera
    score: Score
    surfaces: GridSurface | None
    context: Any

    def __init__(
        self,
        cloud: PointCloud,
        visited: Pose,
        num_visited: Int[Array, ""],
        camera: Camera,
        score: Score,
        surfaces: GridSurface | None,
    ):
        self.cloud, self.visited, self.num_visited = cloud, visited, num_visited
        self.camera, self.score, self.surfaces = camera, score, surfaces
        self.context = None if surfaces is None else score.context(cloud)

    def acquisition(self, poses: Pose, samples: slice = slice(None)) -> Float[Array, " poses"]:
        """The acquisition at a batch of poses, estimated from all posterior samples or from a part of them."""
        return jnp.mean(self.scores(poses, samples), axis=0)

    def scores(self, poses: Pose, samples: slice = slice(None)) -> Float[Array, "samples poses"]:
        """The scores whose mean is the acquisition, sample by sample."""
        surfaces = jax.tree.map(lambda leaf: leaf[samples], self._sampled)
        return sample_scores(self.score, self.context, surfaces, self.camera, poses)

    @property
    def num_samples(self) -> int:
        """How many posterior samples there are."""
        return self._sampled.values.shape[0]

    @property
    def _sampled(self) -> GridSurface:
        if self.surfaces is None:
            raise InputError("the acquisition needs posterior samples: set uses_samples = True on the search")
        return self.surfaces

    def is_visited(self, poses: Pose) -> Bool[Array, " poses"]:
        """Whether each of a batch of poses equals one taken before, to 1e-3 in position and viewing direction."""
        near = jnp.linalg.norm(poses.position[:, None] - self.visited.position[None], axis=-1) < 1e-3
        aligned = jnp.linalg.norm(poses.forward[:, None] - self.visited.forward[None], axis=-1) < 1e-3
        return jnp.any(near & aligned & self._is_filled, axis=1)

    def distance_to_visited(self, poses: Pose) -> Float[Array, " poses"]:
        """Distance from each of a batch of positions to the nearest one taken before; infinite if there is none."""
        distance = jnp.linalg.norm(poses.position[:, None] - self.visited.position[None], axis=-1)
        return jnp.min(jnp.where(self._is_filled, distance, jnp.inf), axis=1)

    @property
    def _is_filled(self) -> Bool[Array, " views"]:
        return jnp.arange(self.visited.position.shape[0]) < self.num_visited


class Trajectories(eqx.Module):
    """Where a gradient search stood, step by step, from each of its starts to the end, and the values there.

    - `poses`: with the leading axes of `values`; `iterations` + 1 steps.
    """

    poses: Pose
    values: Float[Array, "*starts steps"]

    @property
    def flat(self) -> tuple[Pose, Float[Array, " looks"]]:
        """All poses and values: the starts, then where each went with its first step, and so on."""
        poses, values = jax.tree.map(lambda rows: jnp.swapaxes(rows, 0, 1), (self.poses, self.values))
        return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), (poses, values))


class Proposal(eqx.Module):
    """A search's answer: the pose to take next, and what it looked at.

    - `value`: the chosen pose's value, in the units of what the search maximises.
    - `candidates`, `values`: the pool of poses and their values; -inf where one was excluded as visited.
    - `standard_errors`: of the values, as means over the posterior samples; `difference_errors`: of each value less
      that of the best candidate, which is known better, since all poses are scored on the same samples. NaN for a
      single sample; None for a search that does not score all candidates on all samples.
    - `trajectories`: those of a gradient search, starting from the best candidates; None for other searches.
    """

    pose: Pose
    value: Float[Array, ""]
    candidates: Pose
    values: Float[Array, " candidates"]
    trajectories: Trajectories | None = None
    standard_errors: Float[Array, " candidates"] | None = None
    difference_errors: Float[Array, " candidates"] | None = None

    def is_level(self, errors: float = 2.0) -> Bool[Array, " candidates"] | None:
        """Which candidates the samples cannot tell from the best one, itself included: those whose value is within so
        many standard errors of the difference. None where these are not known."""
        if self.difference_errors is None:
            return None
        best = jnp.max(self.values)
        return (self.values == best) | (best - self.values <= errors * self.difference_errors)

    @property
    def standard_error(self) -> float | None:
        """Of the chosen pose's value; None where it is not known, or the pose is none of the candidates."""
        if self.standard_errors is None:
            return None
        same = jax.tree.map(lambda rows, row: rows == row, self.candidates, self.pose)
        chosen = np.asarray(jnp.all(same.position, axis=1) & jnp.all(same.rotation, axis=(1, 2)))
        return float(self.standard_errors[chosen.argmax()]) if chosen.any() else None

    @property
    def others_level(self) -> int | None:
        """How many other candidates are level with the best one, within two standard errors; None where that is not
        known, as for a single sample."""
        level = self.is_level()
        if level is None or bool(jnp.isnan(jnp.asarray(self.difference_errors)).any()):
            return None
        return int(jnp.sum(level)) - 1


class Search(eqx.Module):
    """How a pose is found. `uses_samples` says whether posterior samples must be drawn for it."""

    uses_samples: eqx.AbstractClassVar[bool]

    def check(self, score: Score, camera: Camera, capacity: int) -> None:
        """Raise `ValueError` if the search cannot work with a score, a camera and a cloud of so many rows."""
        return

    def quantity(self, score: Score) -> Quantity:
        """What the values of its proposals are: by default the score's."""
        return score.quantity

    @abstractmethod
    def propose(self, problem: Problem, key: PRNGKeyArray) -> Proposal:
        """The pose to take next; a pure function of its arguments, which runs under `jit`."""


class CandidateSearch(Search):
    """A search that chooses one of its candidates.

    - `candidates`: `SphereCandidates`, `GivenPoses` or others; a number stands for so many on the paper's sphere, and a
      batch of poses for these.
    """

    candidates: AnyCandidates = eqx.field(converter=as_candidates, default=SphereCandidates())


def best_unvisited(
    problem: Problem,
    candidates: Pose,
    values: Float[Array, " candidates"],
    tie: float = _TIE,
    scores: Float[Array, "samples candidates"] | None = None,
) -> Proposal:
    """The candidate of the highest value among those not visited yet; the first of them where values tie.

    `tie`: the relative difference within which they do, by default what sums differ by that are added in another order,
    on another number of cores. `scores`: those whose means the values are, for their standard errors.
    """
    values = jnp.where(problem.is_visited(candidates), -jnp.inf, values)
    best = jnp.max(values)
    # Nothing ties with an infinite value, and NaN is told of by the planner.
    tied = values >= best - jnp.where(jnp.isfinite(best), tie * jnp.abs(best), 0.0)
    index = jnp.where(jnp.isfinite(best), jnp.argmax(tied), jnp.argmax(values))
    found = Proposal(candidates[index], values[index], candidates, values)
    if scores is None:
        return found
    of_differences = standard_error(scores - scores[:, index][:, None])
    return dataclasses.replace(found, standard_errors=standard_error(scores), difference_errors=of_differences)


def standard_error(scores: Float[Array, "samples *poses"]) -> Float[Array, "*poses"]:
    """Of the means over the samples; NaN for a single one."""
    count = scores.shape[0]
    squares = jnp.sum((scores - jnp.mean(scores, axis=0)) ** 2, axis=0)
    return jnp.sqrt(squares / (count - 1) / count) if count > 1 else jnp.full(scores.shape[1:], jnp.nan)
