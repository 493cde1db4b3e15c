"""What a study is: its scenes, its methods, what is measured of them, and its settings."""

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
from jaxnbv.studies.engine.episodes import first_showing, sensor_before
from jaxnbv.studies.engine.known import knowing_others, study_sampler
from jaxnbv.studies.engine.measures import WITHOUT_BANK, Claim, Measure, Record
from jaxnbv.studies.engine.searches import search_of
from jaxnbv.studies.engine.tiles import Tiles

_PURPOSES = ("first", "episode", "scene", "measure")


class Scene(eqx.Module):
    """One object under study.

    - `name`: in tables and pictures.
    - `task`: what else the study knows of it: where it is heated, which parts it has.
    """

    index: int
    name: str
    surface: Surface
    task: Any = None


class Study(eqx.Module):
    """What all scenes of a study share, and what it measures. A new study says what is left open here.

    Settings:

    - `views`: in all, the first included.
    - `num_candidates`: on the sphere of `radius`, at which every search but those by gradient looks.
    - `sampler`, `num_samples`, `grid_resolution`, `capacity`: of the planner; the sampler has as many samples
      on a grid of this resolution.
    - `camera`: the sensor; a planner may imagine fewer rays, see `imagined_camera`.
    - `num_starts`, `iterations`: of searches by gradient, which look at half the candidates first.
    - `meshes`: files, one a scene; without any, scenes are procedural.

    What it is:

    - `title`, `explanation`: for tables.
    - `methods`: by name, in order; `reference`: the one that the others are compared with; `further`: methods that are
      run where a command names them; `pictured`: those that pictures show, by default all.
    - `measures`: what tables and the chart show; `claims`: what the paper says of it.
    - `quick`: settings for a first look, on `quick_scenes` scenes.
    - `seed`: of its first views, noise and samples.
    - `bank`: of the shapes that are known, see `shape_bank`; "" for none.
    - `without_bank`: those of the methods that are run once more by one who knows none, as "METHOD-screened".

    **Raises:** `ValueError` for fewer than two views, or fewer candidates than views.
    """

    title: eqx.AbstractClassVar[str]
    explanation: eqx.AbstractClassVar[str]
    methods: eqx.AbstractClassVar[tuple[str, ...]]
    reference: eqx.AbstractClassVar[str]
    measures: eqx.AbstractClassVar[tuple[Measure, ...]]
    seed: eqx.AbstractClassVar[int]
    further: ClassVar[tuple[str, ...]] = ()
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
    meshes: tuple[MeshFile, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        require(
            2 <= self.views <= self.num_candidates,
            f"the study has {self.views} views of {self.num_candidates} candidates; ask for at least two views, and "
            "for as many candidates",
        )

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> "dict[str, Study]":
        """The study that a command asks for, or several by the names of their folders; of one alone the name is "".

        - `options`: settings of its own. `meshes` is a folder, see `files_in`; by the model `known` each of its objects
          is planned by who has seen all others.

        **Raises:** `ValueError` as `files_in` and `study_sampler` do.
        """
        files = cls.files_in(options.pop("meshes")) if "meshes" in options else ()
        settings = {"sampler": study_sampler(model, cls.bank, files, quick=quick), "meshes": files}
        return {"": cls(views=views, **settings | (dict(cls.quick) if quick else {}) | options)}

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        """The meshes in a folder that can be scenes.

        **Raises:** `ValueError` if there is none.
        """
        return mesh_files(folder)

    @property
    def num_scenes(self) -> int | None:
        """How many scenes there are; None for as many as are asked for."""
        return len(self.meshes) or None

    @abstractmethod
    def scene(self, index: int) -> Scene:
        """A scene.

        **Raises:** `ValueError` if there is none of this index, or it cannot be read.
        """

    def file(self, index: int) -> MeshFile | None:
        """The mesh of a scene; None where scenes are procedural.

        **Raises:** `ValueError` if there is none of this index.
        """
        count = len(self.meshes)
        require(
            count == 0 or 0 <= index < count,
            f"there is no scene {index}: the study has {count} meshes, counted from 0; run as many scenes",
        )
        return self.meshes[index] if count else None

    @abstractmethod
    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        """What one of `methods` looks for; scenes share compilations."""

    def search(self, method: str, scene: Scene) -> Search:
        """Of the method's name, or over all candidates by the acquisition."""
        climbs = self.num_starts, self.iterations
        return search_of(method, self.candidates, self.num_candidates, self.radius, *climbs)

    def planner(self, method: str, scene: Scene) -> Planner:
        """The planner of a method, of one that knows no shapes too."""
        known = method.removesuffix(WITHOUT_BANK)
        planner = self.planner_of(self.acquisition(known, scene), self.search(known, scene), scene)
        if known == method:
            return planner
        return dataclasses.replace(planner, sampler=planner.sampler.without_bank)

    def truth(self, scene: Scene) -> Any:
        """What is measured against, computed once a scene: by default its task."""
        return scene.task

    @abstractmethod
    def follow(self, scene: Scene, truth: Any, planner: Planner, episode: Iterator[Step]) -> Record:
        """What is recorded of a planner's episode, as JSON; it may stop early."""

    def facts(self, scene: Scene, truth: Any, first: int) -> Record:
        """What is recorded of the scene itself, as JSON."""
        return {"name": scene.name}

    def tiles(self, record: Record, methods: Sequence[str], pixels: int) -> Tiles | None:
        """How a scene's record is drawn, in tiles of so many pixels along a side; None where it is not."""
        return None

    def sensor(self, scene: Scene) -> Sensor:
        """What the camera sees of a scene."""
        return sensor_before(scene.surface, self.camera)

    def shows_enough(self, scene: Scene, seen: PointCloud) -> bool:
        """Whether a scan can be the first one."""
        return bool(seen.mask.any())

    @classmethod
    def group(cls, record: Record) -> str:
        """The scenes among which tables tell of this one too; "" for none."""
        return ""

    @property
    def candidates(self) -> Candidates:
        """Where the sensor can stand."""
        return SphereCandidates(self.num_candidates, self.radius)

    @property
    def grid(self) -> Grid:
        """Where samples are evaluated."""
        return Grid(self.grid_resolution)

    @property
    def imagined_camera(self) -> Camera:
        """By which planners imagine scans."""
        return self.camera

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """What is known of such a scene: of meshes all but its own, where these are known."""
        return knowing_others(self.sampler, self.meshes, scene.index) if self.meshes else self.sampler

    def planner_of(self, acquisition: Acquisition, search: Search, scene: Scene) -> Planner:
        """A planner with the study's settings, and what is known of such a scene."""
        known = self.sampler_of(scene)
        sampler = dataclasses.replace(known, grid=self.grid, num_samples=self.num_samples)
        planned = acquisition, search, self.imagined_camera, sampler
        return Planner(*planned, capacity=self.capacity, max_views=self.views)

    def key(self, index: int, purpose: str) -> PRNGKeyArray:
        """What is random in a scene depends on the study, the scene and the purpose alone."""
        of_scene = jax.random.fold_in(jax.random.key(self.seed), index)
        return jax.random.fold_in(of_scene, _PURPOSES.index(purpose))

    def episode_keys(self, method: str, scene: Scene) -> list[PRNGKeyArray]:
        """The key of a method's episode, which all methods share; several for several episodes, see `joined`."""
        return [self.key(scene.index, "episode")]

    def joined(self, runs: Sequence[Record]) -> Record:
        """The record of a method that is made of those of its episodes."""
        return runs[0]

    def first_view(self, scene: Scene) -> int:
        """A random one of the candidates from which the object shows enough."""

        def enough(seen: PointCloud) -> bool:
            return self.shows_enough(scene, seen)

        keys = self.key(scene.index, "first"), self.key(scene.index, "episode")
        first = first_showing(enough, self.candidates.poses(), self.sensor(scene), *keys)
        if first is None:
            raise InputError(f"none of {self.num_candidates} candidates shows enough of {scene.name}: ask for more")
        return first
