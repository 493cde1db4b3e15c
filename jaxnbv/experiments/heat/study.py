"""The study of heat: how near does the coldest point of the scanned cloud come to the object's?"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from scipy.spatial import cKDTree

from jaxnbv.acquisition import ExpectedUtilityImprovement, Score
from jaxnbv.camera import Camera, Pose
from jaxnbv.checks import AnyArray, InputError, require
from jaxnbv.cloud import PointCloud
from jaxnbv.datasets import HeatScene, heat_scene
from jaxnbv.diffusion import HeatProblem
from jaxnbv.episode import observe_scene, scene_sensor, steps, view_keys
from jaxnbv.experiments.meshes import numbered_mesh
from jaxnbv.planner import Planner
from jaxnbv.scanning import Carving, Grid, SDFSurface, SensorNoise, TriangleMesh, mesh_from_sdf
from jaxnbv.search import (
    DiscreteSearch,
    FarthestView,
    HalvingSearch,
    Proposal,
    RandomView,
    SphereCandidates,
    UncertaintyView,
)
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.surfaces import ScreenedSPSR, SurfaceModel
from jaxnbv.tasks import ColdestPoint, Coverage, body_temperature

_SEARCHES = {
    "heat": DiscreteSearch,
    "heat-reached": DiscreteSearch,
    "heat-halving": HalvingSearch,
    "coverage": DiscreteSearch,
    "farthest": FarthestView,
    "uncertainty": UncertaintyView,
    "random": RandomView,
}
METHODS = tuple(_SEARCHES)
# Those that seek cold; the other methods know nothing of heat.
HEAT_METHODS = METHODS[:3]
# The points among which a cloud's coldest is sought: all, or those that the source warms.
ESTIMATES = ("all", "reached")
# The authors' sphere of cameras for this task, in scene units.
HEAT_RADIUS = 3.0
# Points colder than this share of the range of temperatures count as coldest: objects have symmetries, and the inner
# floor of a mug is as cold all over.
_NEARLY = 0.01
# Fine enough for the thinnest rods, of radius 0.04.
_TRUE_GRID = Grid(160)


class HeatStudy(eqx.Module):
    """What all scenes of a study share.

    - `meshes`: files of the objects, one a scene (`mesh_files`), each heated at a random point; without any, scenes are
      those of `heat_scene`.
    - `views`: in all, the first included.
    - `num_candidates`: on the sphere of radius 3.
    - `num_samples`, `model`, `carving`, `grid_resolution`, `capacity`: of the planner.
    - `num_points`: points of D to which imagined scans are added, where the temperature is simulated.
    - `imagined_rays`: rays along a side of an imagined scan; true scans have 50 x 50.
    """

    meshes: tuple[str, ...] = eqx.field(static=True, default=())
    views: int = eqx.field(static=True, default=6)
    num_candidates: int = eqx.field(static=True, default=32)
    num_samples: int = eqx.field(static=True, default=8)
    model: SurfaceModel = eqx.field(default_factory=ScreenedSPSR)
    carving: Carving | None = Carving()
    grid_resolution: int = eqx.field(static=True, default=64)
    capacity: int = eqx.field(static=True, default=4096)
    num_points: int = eqx.field(static=True, default=1024)
    imagined_rays: int = eqx.field(static=True, default=24)

    def __check_init__(self):
        require(
            2 <= self.views <= self.num_candidates,
            f"the study has {self.views} views of {self.num_candidates} candidates; ask for at least two views, and "
            "for as many candidates",
        )

    def planner(self, method: str, source: Float[AnyArray, "3"]) -> Planner:
        """The planner of a method for an object that is heated at `source`; scenes share compilations.

        **Raises:** `ValueError` for an unknown method.
        """
        require(method in METHODS, f"there is no method {method}: choose from {', '.join(METHODS)}")
        score: Score = Coverage()
        if method in HEAT_METHODS:
            coldest = ColdestPoint(source, reached_only=method == "heat-reached")
            score = ExpectedUtilityImprovement(coldest, self.num_points)
        camera = Camera(height=self.imagined_rays, width=self.imagined_rays)
        search = _SEARCHES[method](SphereCandidates(self.num_candidates, HEAT_RADIUS))
        grid = Grid(self.grid_resolution)
        return Planner(
            self.model, camera, score, search, self.num_samples, grid, self.capacity, self.views, self.carving
        )

    def scene(self, index: int) -> HeatScene:
        """An object and where it is heated.

        **Raises:** `ValueError` if there is no mesh of this index, or it cannot be read.
        """
        if not self.meshes:
            return heat_scene(index)
        mesh = numbered_mesh(self.meshes, index)
        (source,) = mesh.sample_points(_key(index, "source"), 1)
        return HeatScene(mesh, Path(self.meshes[index]).name, jnp.asarray(source, jnp.result_type(float)))

    def poses(self) -> Pose:
        """The candidates."""
        return sphere_candidates(self.num_candidates, HEAT_RADIUS)


class Truth(NamedTuple):
    """The temperature of the object itself.

    - `mesh`: its surface.
    - `points`, `temperatures`: of that surface, a fortieth of a scene unit apart, in degrees.
    """

    mesh: TriangleMesh
    points: Float[np.ndarray, "n 3"]
    temperatures: Float[np.ndarray, " n"]

    @property
    def coldest(self) -> Float[np.ndarray, "3"]:
        """The coldest point."""
        return self.points[np.argmin(self.temperatures)]

    @property
    def region(self) -> Float[np.ndarray, "m 3"]:
        """All points whose temperature is the least to within a hundredth of the range."""
        low, high = self.temperatures.min(), self.temperatures.max()
        return self.points[self.temperatures <= low + _NEARLY * (high - low)]


def true_temperature(scene: HeatScene) -> Truth:
    """The temperature of an object's whole surface."""
    mesh = scene.surface
    if isinstance(mesh, SDFSurface):
        mesh = mesh_from_sdf(mesh.sdf, _TRUE_GRID)
    if not isinstance(mesh, TriangleMesh):
        raise InputError(f"the temperature of a {type(mesh).__name__} is not known: give a mesh or a signed distance")
    points, temperature = body_temperature(mesh, heat_problem(scene))
    return Truth(mesh, points, temperature.values)


def heat_problem(scene: HeatScene) -> HeatProblem:
    """The authors' problem, heated where the scene says."""
    return HeatProblem(np.asarray(scene.source))


def run_scene(study: HeatStudy, index: int, methods: Sequence[str] = METHODS) -> dict:
    """One scene with every method: the record that the tables and figures are made of.

    All methods share the first view, a random one of the candidates that see the heat source; the sensor's noise; and
    the prior's samples at each view. Of each it keeps the candidates that were taken, and after each view the share of
    the points that the source warms and two estimates of the coldest point, one among all points and one among those
    (among all, where there are none): where it is, its temperature, its distance to the nearest of the object's points
    that are as cold as can be to within a hundredth of the range of temperatures (`distances`), and that to the very
    coldest one (`point_distances`). Of each step it keeps the value of the view that was chosen, zero for a heat method
    if no view is worth anything, and the seconds of the search.

    With both "heat" and "heat-halving", each step of the first asks the other search too: whether it finds the same
    view, how much less its view is worth by the value of the full search, and its seconds.

    **Raises:** `ValueError` for an unknown method, or a scene whose heat source no candidate sees.
    """
    unknown = sorted({*methods} - {*METHODS})
    require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(METHODS)}")
    start = time.perf_counter()
    scene = study.scene(index)
    first, truth = _first_view(study, scene, index), true_temperature(scene)
    runs = {}
    for method in methods:
        compare = method == "heat" and "heat-halving" in methods
        run = _run(study, scene, index, method, first, compare)
        clouds = run.pop("clouds")
        runs[method] = run | _estimates(clouds, heat_problem(scene), truth)
    return {
        "scene": index,
        "name": scene.name,
        "first": first,
        "truth": {
            "point": truth.coldest.tolist(),
            "temperature": float(truth.temperatures.min()),
            "hottest": float(truth.temperatures.max()),
        },
        "methods": runs,
        "seconds": time.perf_counter() - start,
    }


def _run(study: HeatStudy, scene: HeatScene, index: int, method: str, first: int, compare: bool) -> dict:
    """The episode; the other search is asked at each step with the same state and samples."""
    planner, key, poses = study.planner(method, scene.source), _key(index, "episode"), study.poses()
    halving = study.planner("heat-halving", scene.source) if compare else None
    candidates, clouds, taken, compared = [first], [], [], []
    before, camera = None, scene_sensor(scene.surface, Camera())

    def sensor(pose, noise_key):
        # From the candidate itself: a compiled search may have rounded it otherwise than `seen_clouds` does.
        return camera(poses[_candidate(study, pose)], noise_key)

    for view, step in enumerate(steps(planner, sensor, poses[first], key, Camera())):
        clouds.append(step.state.cloud)
        if before is not None and (proposal := step.view.proposal) is not None:
            candidates.append(_candidate(study, proposal.pose))
            taken.append({"value": float(proposal.value), "seconds": step.seconds})
            if halving is not None:
                start = time.perf_counter()
                halved = jax.block_until_ready(halving.choose(before, step.surfaces, view_keys(key, view)[1]))
                compared.append(_compare(study, proposal, halved, time.perf_counter() - start))
        before = step.state
    run = {"candidates": candidates, "steps": taken, "clouds": clouds}
    return run | {"halving": compared} if compare else run


def _compare(study: HeatStudy, full: Proposal, halved: Proposal, seconds: float) -> dict:
    found = _candidate(study, halved.pose)
    return {
        "same": found == _candidate(study, full.pose),
        "regret": float(full.value - full.values[found]),
        "seconds": seconds,
        "evaluations": halving_evaluations(study.num_candidates, study.num_samples),
        "full_evaluations": study.num_candidates * study.num_samples,
    }


def halving_evaluations(candidates: int, samples: int) -> int:
    """How many imagined scans a `HalvingSearch` scores; a `DiscreteSearch` scores `candidates` * `samples`."""
    left, scored, total = candidates, 0, 0
    while scored < samples:
        left = max(1, left // 2) if scored else left
        more = min(max(scored, HalvingSearch.first_samples), samples - scored)
        total, scored = total + left * more, scored + more
    return total


def _estimates(clouds: Sequence[PointCloud], heat: HeatProblem, truth: Truth) -> dict:
    tree = cKDTree(truth.region)
    lists = ("points", "temperatures", "distances", "point_distances")
    estimates: dict[str, dict[str, list]] = {name: {key: [] for key in lists} for name in ESTIMATES}
    shares = []
    for cloud in clouds:
        points, temperature = body_temperature(cloud, heat)
        shares.append(float(temperature.reached.mean()))
        for name, into in estimates.items():
            coldest = temperature.coldest(name == "reached" and bool(temperature.reached.any()))
            into["points"].append(points[coldest].tolist())
            into["temperatures"].append(float(temperature.values[coldest]))
            into["distances"].append(float(tree.query(points[coldest])[0]))
            into["point_distances"].append(float(np.linalg.norm(points[coldest] - truth.coldest)))
    return {"reached": shares, "estimates": estimates}


def seen_clouds(study: HeatStudy, index: int, candidates: Sequence[int]) -> list[PointCloud]:
    """D after each of the given views of a scene, noise included: those of a record's method."""
    scene = study.scene(index)
    planner = study.planner("farthest", scene.source)
    views = ((study.poses()[one], _scan(study, scene, index, one, view)) for view, one in enumerate(candidates))
    return [state.cloud for state in planner.replay(views, Camera())]


def _scan(study: HeatStudy, scene: HeatScene, index: int, candidate: int, view: int) -> PointCloud:
    _, _, noise_key = view_keys(_key(index, "episode"), view)
    return observe_scene(scene.surface, Camera(), study.poses()[candidate], SensorNoise(), noise_key)


def _first_view(study: HeatStudy, scene: HeatScene, index: int) -> int:
    for candidate in jax.random.permutation(_key(index, "first"), study.num_candidates).tolist():
        points, _ = _scan(study, scene, index, candidate, 0).to_numpy()
        if (np.linalg.norm(points - np.asarray(scene.source), axis=1) <= HeatProblem.radius).any():
            return candidate
    raise InputError(f"none of {study.num_candidates} candidates sees the heat source of scene {index}: give more")


def _candidate(study: HeatStudy, pose: Pose) -> int:
    return int(np.argmin(np.linalg.norm(np.asarray(study.poses().position) - np.asarray(pose.position), axis=1)))


def _key(index: int, purpose: str) -> PRNGKeyArray:
    purposes = ("first", "episode", "source")
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(8), index), purposes.index(purpose))
