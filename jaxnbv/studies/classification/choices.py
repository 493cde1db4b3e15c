"""Where each method of a study of classification looks next, all asked about the same scans of the same samples."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxnbv.acquisition import Score, Several, sample_scores, zero_if_empty
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.state import State
from jaxnbv.scanning import GridSurface
from jaxnbv.search import CandidateSearch, Problem
from jaxnbv.search.base import best_unvisited
from jaxnbv.search.baselines import uncertain_length
from jaxnbv.studies.engine.diagnostics import rank_correlation, roughness
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import Classifier, ClassScore, Context, MixedEntropy, cross_entropy, entropy

CLASSIFYING = ("cross-entropy", "entropy", "mixed", "tie-break")
_SAMPLING = (*CLASSIFYING, "coverage", "uncertainty")


class Choice(NamedTuple):
    """A candidate; and how well the method's values agreed with what the candidates would truly show, and how rough the
    samples were, None without samples."""

    candidate: int
    diagnostics: dict[str, float | None]


class Chooser:
    """The choices of one scene; what methods have in common is computed once.

    - `planner`: its states and samples; its search has the candidates.
    - `classifier`: of all that was seen; `imagining`: of what was seen, thinned to `num_points`, and an imagined scan.
    - `scans`: what each candidate would truly show; `worth`: what that is worth, where it is known.
    """

    def __init__(
        self,
        planner: Planner,
        classifier: Classifier,
        imagining: Classifier,
        num_points: int,
        scans: PointCloud,
        worth: Int[Array, " candidates"] | None,
        key: PRNGKeyArray,
    ):
        self.planner, self.classifier, self.imagining = planner, classifier, imagining
        self.num_points, self.key = num_points, key
        self.scans, self.worth = scans, None if worth is None else np.asarray(worth, np.float64)
        assert isinstance(planner.search, CandidateSearch)
        self.poses: Pose = planner.search.candidates.poses()
        self.states: dict[tuple[int, ...], State] = {}
        self.answers: dict[tuple[int, ...], np.ndarray] = {}

    def choose(self, visited: tuple[int, ...], methods: Sequence[str], view: int) -> dict[str, Choice]:
        """The best candidate not visited yet, for each of the methods that stand here."""
        values, rough = self.values(visited, methods, view)
        new = ~np.isin(np.arange(self.scans.mask.shape[0]), visited)
        choices = {}
        for method in methods:
            rank = None if self.worth is None else rank_correlation(values[method], self.worth, new)
            best = int(np.argmax(np.where(new, values[method], -np.inf)))
            diagnostics = {"rank_correlation": rank, "roughness": rough if method in _SAMPLING else None}
            choices[method] = Choice(best, diagnostics)
        return choices

    def values(
        self, visited: tuple[int, ...], methods: Sequence[str], view: int
    ) -> tuple[dict[str, np.ndarray], float | None]:
        """The values of all candidates by method, and how rough the samples were."""
        state = self.state(visited)
        values: dict[str, Any] = {}
        if "farthest" in methods:
            values["farthest"] = self._problem(state, None).distance_to_visited(self.poses)
        if "oracle" in methods:
            thinned = _thinned(state.cloud, self.num_points)
            answers = _answers(self.imagining, thinned, self.scans)
            values["oracle"] = cross_entropy(*jnp.broadcast_arrays(classify(self.imagining, thinned), answers))
        rough: float | None = None
        if {*methods} & {*_SAMPLING}:
            posterior = self.planner.posterior(state)
            surfaces = self.planner.sample_surfaces(state, jax.random.fold_in(self.key, view), posterior)
            rough = roughness(self.planner, state, posterior, surfaces)
            classes = (_Entropies(self.imagining, self.num_points),) if {*methods} & {*CLASSIFYING} else ()
            score = Several((Coverage(), *classes))
            found, samples = _expected(score, state.cloud, surfaces, self.planner.camera, self.poses)
            covered, *entropies = found.T
            values["coverage"] = covered
            if entropies:
                values["cross-entropy"], values["entropy"] = entropies
                values["tie-break"] = self._tie_break(state, covered, entropies[0], samples[..., 1])
                undecided = float(entropy(classify(self.imagining, _thinned(state.cloud, self.num_points))))
                values["mixed"] = entropies[0 if undecided > MixedEntropy.threshold else 1]
            if "uncertainty" in methods:
                values["uncertainty"] = _uncertainty(self._problem(state, surfaces), self.poses)
        return {name: np.asarray(of, np.float64) for name, of in values.items()}, rough

    def _tie_break(
        self,
        state: State,
        coverage: Float[Array, " candidates"],
        mean: Float[Array, " candidates"],
        samples: Float[Array, "samples candidates"],
    ) -> Float[Array, " candidates"]:
        """Cross-entropy's values, those of level candidates raised above all others by coverage: the highest is what
        `TieBreakSearch` takes."""
        found = best_unvisited(self._problem(state, None), self.poses, mean, scores=samples)
        level = found.is_level()
        assert level is not None
        return jnp.where(level, found.value + coverage - jnp.min(coverage), mean)

    def state(self, visited: tuple[int, ...]) -> State:
        """After the views of these candidates."""
        if visited not in self.states:
            *before, last = visited
            pose, seen = self.poses[last], self.scans[last]
            self.states[visited] = (
                self.planner.observe(self.state(tuple(before)), pose, seen) if before else self.planner.init(seen, pose)
            )
        return self.states[visited]

    def answer(self, visited: tuple[int, ...]) -> Float[np.ndarray, " classes"]:
        """log p after the views of these candidates."""
        if visited not in self.answers:
            self.answers[visited] = np.asarray(classify(self.classifier, self.state(visited).cloud))
        return self.answers[visited]

    def true_answers(self, first: int) -> Float[np.ndarray, "candidates classes"]:
        """log p after the first view and each of the candidates."""
        return np.asarray(_answers(self.classifier, self.state((first,)).cloud, self.scans))

    def _problem(self, state: State, surfaces: GridSurface | None) -> Problem:
        return Problem(state.cloud, state.poses, state.num_views, self.planner.camera, Coverage(), surfaces)


class _Entropies(ClassScore):
    """The values of `CrossEntropy` and of the reduction of entropy, from one answer of the classifier."""

    classifier: Classifier
    num_points: int = eqx.field(static=True)

    def __call__(self, context: Context, scan: PointCloud) -> Float[Array, "2"]:
        cloud, log_p = context
        log_q = self.classifier(concatenate(cloud, scan))
        both = cross_entropy(log_p, log_q), jnp.maximum(0.0, entropy(log_p) - entropy(log_q))
        return jnp.stack([zero_if_empty(scan, value) for value in both])


@eqx.filter_jit
def classify(classifier: Classifier, cloud: PointCloud) -> Float[Array, " classes"]:
    """log p, compiled."""
    return classifier(cloud)


@eqx.filter_jit
def _expected(
    score: Score, cloud: PointCloud, surfaces: GridSurface, camera: Camera, poses: Pose
) -> tuple[Float[Array, "poses scores"], Float[Array, "samples poses scores"]]:
    """The scores' means, and they themselves."""
    samples = sample_scores(score, score.context(cloud), surfaces, camera, poses)
    return jnp.mean(samples, axis=0), samples


@eqx.filter_jit
def _thinned(cloud: PointCloud, count: int) -> PointCloud:
    return limit_capacity(cloud, count)


@eqx.filter_jit
def _answers(classifier: Classifier, cloud: PointCloud, scans: PointCloud) -> Float[Array, "scans classes"]:
    return jax.lax.map(lambda one: classifier(concatenate(cloud, one)), scans)


@eqx.filter_jit
def _uncertainty(problem: Problem, poses: Pose) -> Float[Array, " poses"]:
    return uncertain_length(problem, poses)
