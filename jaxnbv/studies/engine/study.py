"""Base class of studies: scenes, methods, measures and settings."""

import dataclasses
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.planning.loop import Sensor, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.readers.class_meshes import MeshFile, mesh_files
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, Surface
from jaxnbv.scanning.sensors import SENSOR_RADIUS
from jaxnbv.search import Candidates, Search, SphereCandidates
from jaxnbv.studies.engine.episodes import random_first_view, simulated_sensor
from jaxnbv.studies.engine.known import study_sampler, without_own_shape
from jaxnbv.studies.engine.measures import WITHOUT_BANK, Claim, Measure, Record
from jaxnbv.studies.engine.searches import search_of
from jaxnbv.studies.engine.tiles import Tiles

_PURPOSES = ("first", "episode", "scene", "measure")


class Scene(eqx.Module):
    """One object of a study.

    - `name`: shown in tables and pictures.
    - `task`: other facts about the object, such as its heat source or its parts; the type depends on the study.
    """

    index: int
    name: str
    surface: Surface
    task: Any = None


class Study(eqx.Module):
    """Base class: compares methods of choosing views over many scenes.

    A new study defines the abstract members. Settings:

    - `views`: number of views, the first included.
    - `num_candidates`: candidates on the sphere of `radius` (scene units). Gradient searches start with half as many.
    - `sampler`, `capacity`: as in `Planner`; `num_samples` and `grid_resolution` replace those of the sampler.
    - `camera`: the sensor; a planner may imagine fewer rays, see `imagined_camera`.
    - `num_starts`, `iterations`, `learning_rate`: settings of searches by gradient.
    - `meshes`: mesh files, one per scene; without any, scenes are procedural.

    Class attributes:

    - `title`, `explanation`: texts above the tables.
    - `methods`: names of the methods, in order; `reference`: the method that the others are compared with.
    - `extra_methods`: methods that run only if a command names them; `pictured`: methods in pictures, default: all.
    - `measures`: quantities in tables and the chart; `claims`: the paper's claims about the study.
    - `quick`: settings of a quick run; `quick_scenes`: its number of scenes.
    - `paper`: settings of the paper and its code. `views` may be one of them.
    - `seed`: seed of first views, noise and samples.
    - `bank`: name of the bank of known shapes, see `shape_bank`; "" for none.
    - `without_bank`: methods that run a second time without known shapes, as "METHOD-screened".

    **Raises:** `ValueError` for fewer than two views, or fewer candidates than views.
    """

    title: eqx.AbstractClassVar[str]
    explanation: eqx.AbstractClassVar[str]
    methods: eqx.AbstractClassVar[tuple[str, ...]]
    reference: eqx.AbstractClassVar[str]
    measures: eqx.AbstractClassVar[tuple[Measure, ...]]
    seed: eqx.AbstractClassVar[int]
    extra_methods: ClassVar[tuple[str, ...]] = ()
    pictured: ClassVar[tuple[str, ...]] = ()
    claims: ClassVar[tuple[Claim, ...]] = ()
    radius: ClassVar[float] = SENSOR_RADIUS
    quick: ClassVar[Mapping[str, Any]] = {
        "num_samples": 4,
        "grid_resolution": 48,
        "capacity": 1024,
        "num_starts": 2,
        "iterations": 3,
    }
    quick_scenes: ClassVar[int] = 4
    paper: ClassVar[Mapping[str, Any]] = {
        "num_candidates": 120,
        "num_samples": 16,
        "grid_resolution": 100,
        "capacity": 8192,
        "num_starts": 6,
        "iterations": 20,
        "learning_rate": 0.01,
    }
    bank: ClassVar[str] = ""
    without_bank: ClassVar[tuple[str, ...]] = ("coverage", "uncertainty")

    views: int = eqx.field(static=True, default=5)
    num_candidates: int = eqx.field(static=True, default=48)
    num_samples: int = eqx.field(static=True, default=16)
    sampler: SurfaceSampler = eqx.field(default_factory=SurfaceSampler)
    grid_resolution: int = eqx.field(static=True, default=64)
    capacity: int = eqx.field(static=True, default=4096)
    camera: Camera = Camera()
    num_starts: int = eqx.field(static=True, default=4)
    iterations: int = eqx.field(static=True, default=8)
    learning_rate: float = eqx.field(static=True, default=0.03)
    meshes: tuple[MeshFile, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        require(
            2 <= self.views <= self.num_candidates,
            f"the study has {self.views} views of {self.num_candidates} candidates: give at least two views, and at "
            "least as many candidates as views",
        )

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> "dict[str, Study]":
        """The studies of one command, by the names of their folders; "" for a single study.

        - `options`: settings, which replace those of `quick`. `meshes` is a folder, see `files_in`. With the model
          `known`, the bank for each mesh holds all the other meshes.

        **Raises:** `ValueError` as `files_in` and `study_sampler` do.
        """
        files = cls.files_in(options.pop("meshes")) if "meshes" in options else ()
        settings = {"sampler": study_sampler(model, cls.bank, files, quick=quick), "meshes": files}
        return {"": cls(views=views, **settings | (dict(cls.quick) if quick else {}) | options)}

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        """The meshes in a folder that are usable as scenes.

        **Raises:** `ValueError` if there is no mesh.
        """
        return mesh_files(folder)

    @property
    def num_scenes(self) -> int | None:
        """Number of scenes; None if it is unlimited."""
        return len(self.meshes) or None

    @abstractmethod
    def scene(self, index: int) -> Scene:
        """The scene of an index.

        **Raises:** `ValueError` if there is no such scene, or it cannot be read.
        """

    def file(self, index: int) -> MeshFile | None:
        """The mesh file of a scene; None if scenes are procedural.

        **Raises:** `ValueError` if there is no such scene.
        """
        count = len(self.meshes)
        require(
            count == 0 or 0 <= index < count,
            f"there is no scene {index}: the study has {count} meshes, counted from 0; run at most {count} scenes",
        )
        return self.meshes[index] if count else None

    @abstractmethod
    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        """The acquisition of a method, with one structure in all scenes, so that they share compilations."""

    def search(self, method: str, scene: Scene) -> Search:
        """The search of a method, see `search_of`."""
        climbs = self.num_starts, self.iterations, self.learning_rate
        return search_of(method, self.candidates, self.num_candidates, self.radius, *climbs)

    def planner(self, method: str, scene: Scene) -> Planner:
        """The planner of a method, which may end in "-screened"."""
        name = method.removesuffix(WITHOUT_BANK)
        planner = self.planner_of(self.acquisition(name, scene), self.search(name, scene), scene)
        if name == method:
            return planner
        return dataclasses.replace(planner, sampler=planner.sampler.without_bank)

    def truth(self, scene: Scene) -> Any:
        """The ground truth of a scene, computed once; by default its task."""
        return scene.task

    @abstractmethod
    def follow(self, scene: Scene, truth: Any, planner: Planner, episode: Iterator[Step]) -> Record:
        """The record (JSON) of a planner's episode. It may stop drawing steps early."""

    def scene_record(self, scene: Scene, truth: Any, first: int) -> Record:
        """The record (JSON) of the scene itself."""
        return {"name": scene.name}

    def tiles(self, record: Record, methods: Sequence[str], pixels: int) -> Tiles | None:
        """The picture of a scene's record, in tiles of `pixels` x `pixels`; None if the study draws none."""
        return None

    def sensor(self, scene: Scene) -> Sensor:
        """The simulated camera that scans a scene."""
        return simulated_sensor(scene.surface, self.camera)

    def shows_enough(self, scene: Scene, scan: PointCloud) -> bool:
        """Whether a scan shows enough of the object to be the first."""
        return bool(scan.mask.any())

    @classmethod
    def group(cls, record: Record) -> str:
        """Name of the subset of scenes that a record belongs to, tabulated separately; "" for none."""
        return ""

    @property
    def candidates(self) -> Candidates:
        """The candidate poses of the sensor."""
        return SphereCandidates(self.num_candidates, self.radius)

    @property
    def grid(self) -> Grid:
        """The grid on which samples are evaluated."""
        return Grid(self.grid_resolution)

    @property
    def imagined_camera(self) -> Camera:
        """The camera with which planners imagine scans."""
        return self.camera

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """The sampler for a scene. A bank made from `meshes` leaves out the mesh of the scene."""
        return without_own_shape(self.sampler, self.meshes, scene.index) if self.meshes else self.sampler

    def planner_of(self, acquisition: Acquisition, search: Search, scene: Scene) -> Planner:
        """A planner with the study's settings and the sampler of the scene."""
        base = self.sampler_of(scene)
        sampler = dataclasses.replace(base, grid=self.grid, num_samples=self.num_samples)
        planned = acquisition, search, self.imagined_camera, sampler
        return Planner(*planned, capacity=self.capacity, max_views=self.views)

    def key(self, index: int, purpose: str) -> PRNGKeyArray:
        """The random key of a scene for a purpose. It depends only on these and the study's seed."""
        scene_key = jax.random.fold_in(jax.random.key(self.seed), index)
        return jax.random.fold_in(scene_key, _PURPOSES.index(purpose))

    def episode_keys(self, method: str, scene: Scene) -> list[PRNGKeyArray]:
        """Keys of a method's episodes: one that all methods share, or several for `merge_runs`."""
        return [self.key(scene.index, "episode")]

    def merge_runs(self, runs: Sequence[Record]) -> Record:
        """One record of a method, merged from those of its episodes."""
        return runs[0]

    def first_view(self, scene: Scene) -> int:
        """Index of a random candidate from which the object shows enough."""

        def enough(scan: PointCloud) -> bool:
            return self.shows_enough(scene, scan)

        keys = self.key(scene.index, "first"), self.key(scene.index, "episode")
        first = random_first_view(enough, self.candidates.poses(), self.sensor(scene), *keys)
        if first is None:
            raise InputError(f"none of {self.num_candidates} candidates shows enough of {scene.name}: ask for more")
        return first
