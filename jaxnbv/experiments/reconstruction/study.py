"""The study of reconstruction: how near is the surface that a method's views give to the true one?"""

import itertools
import time
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxnbv.camera import Camera
from jaxnbv.checks import InputError, require
from jaxnbv.cloud import PointCloud
from jaxnbv.datasets import Split
from jaxnbv.datasets.parts import part_scene
from jaxnbv.episode import observe_scene, scene_sensor, steps, view_keys
from jaxnbv.experiments.meshes import numbered_mesh
from jaxnbv.experiments.metrics import coverage, truth_points
from jaxnbv.experiments.reconstruction.distances import SURFACE_POINTS, surface_distance
from jaxnbv.networks.shapenet import CATEGORIES
from jaxnbv.planner import Planner
from jaxnbv.reconstruction import has_poisson, mean_mesh, screened_poisson
from jaxnbv.scanning import Carving, Grid, SDFSurface, SensorNoise, Surface, TriangleMesh
from jaxnbv.search import CandidateSearch, DiscreteSearch, FarthestView, RandomView, UncertaintyView
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.surfaces import ScreenedSPSR, SurfaceModel
from jaxnbv.tasks import Coverage

_SEARCHES: dict[str, type[CandidateSearch]] = {
    "coverage": DiscreteSearch,
    "farthest": FarthestView,
    "uncertainty": UncertaintyView,
    "random": RandomView,
}
METHODS = tuple(_SEARCHES)
POISSON, MEAN = "screened Poisson", "posterior mean"
RECONSTRUCTIONS = (POISSON, MEAN)


class ReconstructionStudy(eqx.Module):
    """What all scenes of a study share.

    - `meshes`: files of the objects, one a scene (`mesh_files`); without any, scenes are those of the test split
      of `part_scene`.
    - `views`: in all, the first included.
    - `num_candidates`: on the sphere of radius 2.5.
    - `num_samples`, `model`, `carving`, `grid_resolution`, `capacity`: of the planner. The model's mean is also
      meshed, on the paper's grid of 100^3.
    """

    meshes: tuple[str, ...] = eqx.field(static=True, default=())
    views: int = eqx.field(static=True, default=5)
    num_candidates: int = eqx.field(static=True, default=48)
    num_samples: int = eqx.field(static=True, default=16)
    model: SurfaceModel = eqx.field(default_factory=ScreenedSPSR)
    carving: Carving | None = Carving()
    grid_resolution: int = eqx.field(static=True, default=64)
    capacity: int = eqx.field(static=True, default=4096)

    def __check_init__(self):
        require(
            2 <= self.views <= self.num_candidates,
            f"the study has {self.views} views of {self.num_candidates} candidates; ask for at least two views, and "
            "for as many candidates",
        )

    def planner(self, method: str) -> Planner:
        """The planner of a method; planners differ in their search alone."""
        search, grid = _SEARCHES[method](self.num_candidates), Grid(self.grid_resolution)
        return Planner(
            self.model, Camera(), Coverage(), search, self.num_samples, grid, self.capacity, self.views, self.carving
        )

    def scene(self, index: int) -> Surface:
        """The true surface of a scene, of longest side 2.5.

        **Raises:** `ValueError` if there is no mesh of this index, or it cannot be read.
        """
        if not self.meshes:
            return SDFSurface(part_scene(Split.TEST, index).solid)
        return numbered_mesh(self.meshes, index)

    def name(self, index: int) -> str:
        """What a scene is called: its mesh file, or its category and number."""
        if self.meshes:
            return Path(self.meshes[index]).name
        return f"{CATEGORIES[int(part_scene(Split.TEST, index).category)].name} {index}"


def run_scene(study: ReconstructionStudy, index: int, methods: Sequence[str] = METHODS) -> dict:
    """One scene with every method: the record that the tables and figures are made of.

    All methods share the first view, a random one of the candidates that see the object; the candidates; the sensor's
    noise at each view; and the posterior samples of the prior at each view. For each method it keeps the candidates
    that were taken (indices of `sphere_candidates(num_candidates)`), the share of the true surface that is covered
    after each view, and the distances to the true surface of two reconstructions from the last cloud; that by Poisson
    reconstruction is None where `pymeshlab` cannot be imported.

    **Raises:** `ValueError` for an unknown method, a scene that does not exist or cannot be read, or one that no
    candidate sees.
    """
    unknown = sorted({*methods} - {*METHODS})
    require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(METHODS)}")
    start = time.perf_counter()
    scene = study.scene(index)
    truth = truth_points(scene, _key(index, "truth"), SURFACE_POINTS)
    if truth is None:
        raise InputError(f"the surface of scene {index} cannot be sampled: give a mesh")
    first = _first_view(study, scene, index)
    return {
        "scene": index,
        "name": study.name(index),
        "first": first,
        "methods": {method: _run(study, scene, index, method, first, truth) for method in methods},
        "seconds": time.perf_counter() - start,
    }


def _run(
    study: ReconstructionStudy, scene: Surface, index: int, method: str, first: int, truth: Float[np.ndarray, "n 3"]
) -> dict:
    poses = sphere_candidates(study.num_candidates)
    episode = steps(study.planner(method), scene_sensor(scene, Camera()), poses[first], _key(index, "episode"))
    candidates, covered = [], []
    for view, *_ in itertools.islice(episode, study.views):
        candidates.append(first if view.proposal is None else int(np.argmax(view.proposal.values)))
        covered.append(coverage(view.cloud, truth))
        cloud = view.cloud
    meshes = {name: reconstruct(study, cloud, name) for name in RECONSTRUCTIONS}
    return {
        "candidates": candidates,
        "coverage": covered,
        "points": int(cloud.count),
        "reconstructions": {name: _distances(mesh, truth, index) for name, mesh in meshes.items()},
    }


def reconstruct(study: ReconstructionStudy, cloud: PointCloud, name: str) -> TriangleMesh | None:
    """One of `RECONSTRUCTIONS` from a cloud; None for Poisson reconstruction where `pymeshlab` cannot be imported."""
    if name == MEAN:
        return mean_mesh(study.model, cloud)
    return screened_poisson(cloud) if has_poisson() else None


def seen_cloud(study: ReconstructionStudy, index: int, candidates: Sequence[int]) -> PointCloud:
    """D after the given views of a scene, noise included: that which a record's reconstructions were made from."""
    scene, poses, key = study.scene(index), sphere_candidates(study.num_candidates), _key(index, "episode")
    require(len(candidates) > 0, "there are no views to scan again: give at least one candidate")
    planner, sensor = study.planner("farthest"), scene_sensor(scene, Camera())
    seen = ((poses[one], sensor(poses[one], view_keys(key, view)[2])) for view, one in enumerate(candidates))
    *_, last = planner.replay(seen)
    return last.cloud


def _distances(mesh: TriangleMesh | None, truth: Float[np.ndarray, "n 3"], index: int) -> dict | None:
    if mesh is None:
        return None
    distance = surface_distance(mesh.sample_points(_key(index, "reconstruction"), SURFACE_POINTS), truth)
    return {"chamfer": distance.chamfer, **distance._asdict()}


def _first_view(study: ReconstructionStudy, scene: Surface, index: int) -> int:
    poses, key = sphere_candidates(study.num_candidates), _key(index, "first")
    for candidate in jax.random.permutation(key, study.num_candidates).tolist():
        if observe_scene(scene, Camera(), poses[candidate], SensorNoise(), key).mask.any():
            return candidate
    raise InputError(f"none of {study.num_candidates} candidates sees anything of {study.name(index)}: give more")


def _key(index: int, purpose: str) -> PRNGKeyArray:
    purposes = ("first", "episode", "truth", "reconstruction")
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(4), index), purposes.index(purpose))
