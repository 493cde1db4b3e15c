"""The study of the synthetic pyramid: same scenes, first cameras, candidates and noise for all methods."""

import time
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.camera import Camera, Pose
from jaxnbv.checks import require
from jaxnbv.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.datasets import Framing, Split, pyramid_scene
from jaxnbv.datasets.pyramid import choose_hidden, scan_pattern
from jaxnbv.experiments.diagnostics import rank_correlation, roughness
from jaxnbv.experiments.pyramid.report import METHODS
from jaxnbv.planner import Planner, State
from jaxnbv.scanning import Carving, Grid, GridSurface, SensorNoise, scan
from jaxnbv.search import DiscreteSearch, Problem
from jaxnbv.search.baselines import uncertain_length
from jaxnbv.search.candidates import SENSOR_RADIUS, sphere_candidates
from jaxnbv.surfaces import SurfaceModel
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import Classifier, MixedEntropy, cross_entropy, entropy

_CLASSIFYING = ("cross-entropy", "entropy", "mixed")
_SAMPLING = (*_CLASSIFYING, "coverage", "uncertainty")
_RANDOM_RUNS = 8


class PyramidStudy(eqx.Module):
    """What all scenes of a study share.

    - `classifier`: of clouds in scene coordinates; it says what is known after each view.
    - `imagining`: the classifier of D u scan for imagined scans, by default the same; one that is fed fewer points
      saves time.
    - `framing`: how large the object stands before the sensor.
    - `split`: which scenes; tune on those of the validation split.
    - `views`: in all, the first included.
    - `num_candidates`: on the sphere of radius 2.5.
    - `model`, `carving`, `num_samples`, `grid_resolution`, `capacity`: of the planner.
    - `num_points`: D is thinned to so many, once a step, before imagined scans are added to it.
    """

    classifier: Classifier
    framing: Framing = eqx.field(static=True)
    model: SurfaceModel
    carving: Carving | None
    split: Split = eqx.field(static=True, default=Split.TEST)
    views: int = eqx.field(static=True, default=5)
    num_candidates: int = eqx.field(static=True, default=48)
    num_samples: int = eqx.field(static=True, default=16)
    grid_resolution: int = eqx.field(static=True, default=64)
    capacity: int = eqx.field(static=True, default=4096)
    num_points: int = eqx.field(static=True, default=512)
    imagining: Classifier | None = None

    def __check_init__(self):
        require(
            2 <= self.views <= self.num_candidates,
            f"the study has {self.views} views of {self.num_candidates} candidates; ask for at least two views, and "
            "for as many candidates",
        )

    @property
    def planner(self) -> Planner:
        """The grid keeps its proportion to the object in both framings."""
        grid = Grid(self.grid_resolution, 0.7 * self.framing.longest_side)
        search, samples = DiscreteSearch(), self.num_samples
        return Planner(self.model, Camera(), Coverage(), search, samples, grid, self.capacity, carving=self.carving)


def run_scene(study: PyramidStudy, index: int, methods: Sequence[str] = METHODS) -> dict:
    """One scene with every method: the record that the tables and figures are made of."""
    return _Scene(study, index).record(methods)


class _Truth(eqx.Module):
    """What each candidate would truly show: scans with noise, and how many rays hit the pattern."""

    scans: PointCloud
    pattern_pixels: Int[Array, " candidates"]
    angles: Float[Array, " candidates"]
    label: Int[Array, ""]


class _Scene:
    """One scene under study; what methods have in common is computed once."""

    def __init__(self, study: PyramidStudy, index: int):
        self.study, self.index, self.planner = study, index, study.planner
        self.imagining = study.classifier if study.imagining is None else study.imagining
        self.poses = sphere_candidates(study.num_candidates)
        # A hit this near lies outside the ball of radius 0.6 longest sides about the origin, towards the sensor.
        self.near = SENSOR_RADIUS - 0.6 * study.framing.longest_side
        self.truth = _truth(self.poses, jnp.asarray(index), study.split, study.framing)
        self.pattern_pixels = np.asarray(self.truth.pattern_pixels)
        self.key = jax.random.fold_in(jax.random.key(2), index)
        self.first = self._first_view()
        self.states: dict[tuple[int, ...], State] = {}
        self.answers: dict[tuple[int, ...], np.ndarray] = {}
        self.diagnostics: list[dict] = []

    def record(self, methods: Sequence[str]) -> dict:
        start = time.perf_counter()
        first = (self.first,)
        runs: dict[str, list[tuple[int, ...]]] = {method: [first] for method in methods}
        if "random" in runs:
            runs["random"] = [self._random_run(run) for run in range(_RANDOM_RUNS)]
        for view in range(2, self.study.views + 1):
            together: dict[tuple[int, ...], list[str]] = {}
            for method in methods:
                if method != "random":
                    together.setdefault(runs[method][0], []).append(method)
            for visited, group in together.items():
                values = self._acquisitions(visited, group, view)
                for method in group:
                    runs[method] = [(*visited, int(np.argmax(_without(values[method], visited))))]
        answers = np.asarray(_answers(self.study.classifier, self._state(first).cloud, self.truth.scans))
        correct = answers.argmax(axis=1) == int(self.truth.label)
        unvisited = np.arange(len(correct)) != self.first
        return {
            "scene": self.index,
            "framing": self.study.framing.value,
            "split": self.study.split.value,
            "label": int(self.truth.label),
            "first": self.first,
            "angle": float(self.truth.angles[self.first]),
            "pattern_pixels": self.pattern_pixels.tolist(),
            "random_hit": float(np.mean(correct[unvisited])),
            "methods": {name: {"runs": [self._run(visited) for visited in of]} for name, of in runs.items()},
            "diagnostics": self.diagnostics,
            "seconds": time.perf_counter() - start,
        }

    def _run(self, visited: tuple[int, ...]) -> dict:
        log_p = [self._classify(visited[:count]).tolist() for count in range(1, len(visited) + 1)]
        pixels = self.pattern_pixels[list(visited)].tolist()
        return {"candidates": list(visited), "pattern_pixels": pixels, "log_p": log_p}

    def _first_view(self) -> int:
        return choose_hidden(self.pattern_pixels, self.truth.scans, jax.random.fold_in(self.key, 0))

    def _random_run(self, run: int) -> tuple[int, ...]:
        others = np.delete(np.arange(self.study.num_candidates), self.first)
        key = jax.random.fold_in(jax.random.fold_in(self.key, 1), run)
        chosen = jax.random.choice(key, others, (self.study.views - 1,), replace=False)
        return (self.first, *(int(index) for index in chosen))

    def _state(self, visited: tuple[int, ...]) -> State:
        if visited not in self.states:
            *before, last = visited
            pose, seen = self.poses[last], self.truth.scans[last]
            self.states[visited] = (
                self.planner.observe(self._state(tuple(before)), pose, seen)
                if before
                else self.planner.init(seen, pose)
            )
        return self.states[visited]

    def _classify(self, visited: tuple[int, ...]) -> np.ndarray:
        if visited not in self.answers:
            self.answers[visited] = np.asarray(_classify(self.study.classifier, self._state(visited).cloud))
        return self.answers[visited]

    def _acquisitions(self, visited: tuple[int, ...], methods: Sequence[str], view: int) -> dict[str, np.ndarray]:
        """Values of all candidates for the methods that stand here, from one set of posterior samples."""
        state = self._state(visited)
        thinned = _thin(state.cloud, self.study.num_points)
        log_p = _classify(self.imagining, thinned)
        values: dict[str, np.ndarray] = {}
        if "farthest" in methods:
            values["farthest"] = np.asarray(self._problem(state, None).distance_to_visited(self.poses))
        if "oracle" in methods:
            true_answers = _answers(self.imagining, thinned, self.truth.scans)
            values["oracle"] = np.asarray(_cross_entropies(log_p, true_answers))
        self._diagnose(view, visited, values, None, None)
        sampling = [method for method in methods if method in _SAMPLING]
        if sampling:
            posterior = self.planner.posterior(state)
            key = jax.random.fold_in(jax.random.fold_in(self.key, 2), view)
            surfaces = self.planner.sample_surfaces(state, key, posterior)
            classifier = self.imagining if {*_CLASSIFYING} & {*sampling} else None
            log_q, covered, near = _imagine(classifier, thinned, state.cloud, surfaces, self.near, self.poses)
            found = {"coverage": np.asarray(covered)}
            if log_q is not None:
                found |= _classification_values(log_p, log_q)
            if "uncertainty" in methods:
                found["uncertainty"] = np.asarray(_uncertainty(self._problem(state, surfaces), self.poses))
            found = {method: found[method] for method in sampling}
            self._diagnose(view, visited, found, roughness(self.planner, state, posterior, surfaces), float(near))
            values |= found
        return values

    def _diagnose(self, view, visited, values: dict[str, np.ndarray], rough: float | None, near: float | None) -> None:
        unvisited = ~np.isin(np.arange(len(self.pattern_pixels)), visited)
        worth = self.pattern_pixels.astype(np.float64)
        correlations = {name: rank_correlation(of, worth, unvisited) for name, of in values.items()}
        found = {"roughness": rough, "near_sensor": near, "rank_correlation": correlations}
        if values:
            self.diagnostics.append({"view": view, "methods": list(values), **found})

    def _problem(self, state: State, surfaces: GridSurface | None) -> Problem:
        return Problem(state.cloud, state.poses, state.num_views, self.planner.camera, Coverage(), surfaces)


def _without(values: np.ndarray, visited: tuple[int, ...]) -> np.ndarray:
    values = np.array(values, dtype=np.float64)
    values[list(visited)] = -np.inf
    return values


@eqx.filter_jit
def _truth(poses: Pose, index: Int[Array, ""], split: Split, framing: Framing) -> _Truth:
    pyramid = pyramid_scene(split, index, framing)
    pixels, scans = scan_pattern(pyramid, Camera(), poses)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(3), index), len(pixels))
    direction = poses.position / jnp.linalg.norm(poses.position, axis=-1, keepdims=True)
    # The base looks along -z of the pyramid's own frame.
    angles = jnp.degrees(jnp.arccos(jnp.clip(-direction @ pyramid.rotation[:, 2], -1.0, 1.0)))
    return _Truth(jax.vmap(SensorNoise())(scans, keys), pixels, angles, pyramid.label)


@eqx.filter_jit
def _thin(cloud: PointCloud, count: int) -> PointCloud:
    return limit_capacity(cloud, count)


@eqx.filter_jit
def _classify(classifier: Classifier, cloud: PointCloud) -> Float[Array, " classes"]:
    return classifier(cloud)


@eqx.filter_jit
def _answers(classifier: Classifier, cloud: PointCloud, scans: PointCloud) -> Float[Array, "scans classes"]:
    return jax.lax.map(lambda one: classifier(concatenate(cloud, one)), scans)


@eqx.filter_jit
def _imagine(
    classifier: Classifier | None,
    thinned: PointCloud,
    cloud: PointCloud,
    surfaces: GridSurface,
    near: float,
    poses: Pose,
) -> tuple[Float[Array, "samples poses classes"] | None, Float[Array, " poses"], Float[Array, ""]]:
    """What each sample would show: log p given D and each scan, coverage, and the share of hits near the sensor."""
    coverage = Coverage()
    context = coverage.context(cloud)

    def of_sample(surface):
        scans = scan(surface, Camera(), poses)
        depth = jnp.linalg.norm(scans.points - poses.position[:, None], axis=-1)
        share = jnp.sum(scans.mask & (depth < near)) / jnp.maximum(jnp.sum(scans.mask), 1)
        answers = None if classifier is None else _answers(classifier, thinned, scans)
        return answers, jax.vmap(lambda one: coverage(context, one))(scans), share

    log_q, covered, share = jax.lax.map(of_sample, surfaces)
    return log_q, jnp.mean(covered, axis=0), jnp.mean(share)


def _cross_entropies(log_p, log_q) -> Float[Array, "..."]:
    return cross_entropy(jnp.broadcast_to(log_p, log_q.shape), jnp.asarray(log_q))


def _classification_values(
    log_p: Float[Array, " classes"], log_q: Float[Array, "s c classes"]
) -> dict[str, np.ndarray]:
    """`CrossEntropy`, `ExpectedUtilityImprovement(NegativeEntropy)` and `MixedEntropy` of the same answers."""
    cross = jnp.mean(_cross_entropies(log_p, log_q), axis=0)
    reduction = jnp.mean(jnp.maximum(0.0, entropy(log_p) - entropy(log_q)), axis=0)
    mixed = cross if float(entropy(log_p)) > MixedEntropy.threshold else reduction
    return {"cross-entropy": np.asarray(cross), "entropy": np.asarray(reduction), "mixed": np.asarray(mixed)}


@eqx.filter_jit
def _uncertainty(problem: Problem, poses: Pose) -> Float[Array, " poses"]:
    return uncertain_length(problem, poses)
