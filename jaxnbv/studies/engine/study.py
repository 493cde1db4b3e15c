"""What a study is, and the engine that runs one scene of it with every method."""

import dataclasses
import itertools
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, check_type, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.episode import Sensor, Step, observe_scene, steps, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SensorNoise, Surface
from jaxnbv.scanning.sensors import SENSOR_RADIUS
from jaxnbv.search import Candidates, Search, SphereCandidates
from jaxnbv.studies.engine.known import knowing_meshes, knowing_others
from jaxnbv.studies.engine.measures import KNOWN, WITHOUT_BANK, Claim, Measure, Record
from jaxnbv.studies.engine.searches import search_of
from jaxnbv.studies.engine.tiles import Tiles
from jaxnbv.readers.class_meshes import MeshFile, mesh_files
from jaxnbv.surfaces.shipped_banks import bank_poses, shape_bank

# The file of a study's chart.
CHART = "chart.png"
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

        **Raises:** `ValueError` as `files_in` and `imagined` do.
        """
        files = cls.files_in(options.pop("meshes")) if "meshes" in options else ()
        if files and model == KNOWN:
            sampler = knowing_meshes(cls.imagined("screened", quick=quick), files)
        else:
            sampler = cls.imagined(model, quick=quick)
        settings = {"sampler": sampler, "meshes": files} | (dict(cls.quick) if quick else {})
        return {"": cls(views=views, **settings | options)}

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        """The meshes in a folder that can be scenes.

        **Raises:** `ValueError` if there is none.
        """
        return mesh_files(folder)

    @classmethod
    def imagined(
        cls, model: str, longest_side: float = 2.5, quick: bool = False, solid: bool = False
    ) -> SurfaceSampler:
        """As `SurfaceSampler.preset`, or for the model `known` the screened one that knows the shapes of `bank`.

        **Raises:** `ValueError` for another model, or `known` where there is no bank.
        """
        if model != KNOWN:
            return SurfaceSampler.preset(model, longest_side, quick, solid=solid)
        require(bool(cls.bank), f"there are no known shapes for {cls.title.lower()}: give another model")
        plain = SurfaceSampler.preset("screened", longest_side, quick, solid=solid)
        return plain.with_bank(shape_bank(cls.bank), bank_poses(cls.bank))

    @classmethod
    def chosen(cls, names: Sequence[str] | None, model: str) -> tuple[str, ...]:
        """The methods of these names, in order; by default `methods`, and where shapes are known those of
        `without_bank`.

        **Raises:** `ValueError` for an unknown method.
        """
        twice = [name for name in cls.without_bank if name in cls.methods] if model == KNOWN else []
        again = tuple(f"{name}{WITHOUT_BANK}" for name in twice)
        known = (*cls.methods, *again, *cls.further)
        if names is None:
            return (*cls.methods, *again)
        unknown = sorted({*names} - {*known})
        require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(known)}")
        return tuple(name for name in known if name in names)

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
        return lambda pose, key: observe_scene(scene.surface, self.camera, pose, SensorNoise(), key)

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

    def run_scene(
        self, index: int, methods: Sequence[str] | None = None, own: "Mapping[str, Factory] | None" = None
    ) -> Record:
        """One scene with every method: the record that tables and figures are made of.

        All methods share the first view, a random one of the candidates that show enough, the sensor's noise and the
        prior's samples at each view.

        - `methods`: some of the study's, by default all; `own`: further ones, and what makes their planners.

        **Raises:** `ValueError` for an unknown method, as `scene` does, if no candidate shows enough, or if one of
        `own` makes no planner of so many views.
        """
        methods = self.methods if methods is None else self.chosen(methods, KNOWN)
        start = time.perf_counter()
        scene = self.scene(index)
        planners = {name: self._made(name, make, scene) for name, make in (own or {}).items()}
        first, truth = self.first_view(scene), self.truth(scene)
        record = {"scene": index, **self.facts(scene, truth, first), "first": first, "study_views": self.views}
        planned = {name: self.planner(name, scene) for name in methods}
        record["methods"] = {
            name: self.run(scene, truth, first, name, planner) for name, planner in (planned | planners).items()
        }
        return record | {"seconds": time.perf_counter() - start}

    def _made(self, name: str, make: "Factory", scene: Scene) -> Planner:
        """The planner of a method of one's own."""
        try:
            planner = make(self, scene)
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
            raise InputError(f"the method {name} fails on scene {scene.index} ({problem})") from error
        check_type(planner, Planner, f"what the method {name} makes")
        require(
            planner.max_views >= self.views,
            f"the method {name} makes a planner of {planner.max_views} views, but the study has {self.views}: give "
            f"Planner(max_views={self.views})",
        )
        return planner

    def run(
        self, scene: Scene, truth: Any, first: int, method: str, planner: Planner, key: PRNGKeyArray | None = None
    ) -> Record:
        """The record of one method: its views' poses, of each step the value of the view that was chosen and the
        seconds of the search, and what `follow` makes of the episode.

        - `key`: of the episode, by default the one that all methods share.
        """
        views: list[dict[str, list]] = []
        taken: list[dict[str, float]] = []
        key = self.key(scene.index, "episode") if key is None else key
        episode = steps(planner, self.sensor(scene), self.candidates.poses()[first], key, self.camera)

        def noted() -> Iterator[Step]:
            for step in itertools.islice(episode, self.views):
                pose, proposal = step.view.pose, step.view.proposal
                views.append({"position": pose.position.tolist(), "rotation": pose.rotation.tolist()})
                if proposal is not None:
                    taken.append({"value": float(proposal.value), "seconds": step.seconds})
                yield step

        return {"views": views, "steps": taken, **self.follow(scene, truth, planner, noted())}

    def first_view(self, scene: Scene) -> int:
        """A random one of the candidates from which the object shows enough."""
        poses, sensor = self.candidates.poses(), self.sensor(scene)
        *_, noise_key = view_keys(self.key(scene.index, "episode"), 0)
        for candidate in jax.random.permutation(self.key(scene.index, "first"), self.num_candidates).tolist():
            if self.shows_enough(scene, sensor(poses[candidate], noise_key)):
                return candidate
        raise InputError(f"none of {self.num_candidates} candidates shows enough of {scene.name}: ask for more")

    def seen(self, scene: Scene, run: Record) -> list[tuple[PointCloud, Observations]]:
        """Each scan of a method, and the observations after it, made again from the poses of its record."""
        key, sensor = self.key(scene.index, "episode"), self.sensor(scene)
        poses = enumerate(self.poses_of(run))
        views = [(pose, sensor(pose, view_keys(key, index)[2]), self.camera) for index, pose in poses]
        # It depends on the planner through its capacity and what it carves alone.
        known = self.planner(self.methods[0], scene).replay(views)
        return [(scan, observations) for (_, scan, _), observations in zip(views, known, strict=True)]

    def poses_of(self, run: Record) -> list[Pose]:
        """Where a method's views were taken."""
        arrays = [[np.asarray(view[name], np.float32) for name in ("rotation", "position")] for view in run["views"]]
        return [Pose(rotation, position) for rotation, position in arrays]


# A method of one's own: the planner of a scene.
Factory: TypeAlias = Callable[[Study, Scene], Planner]
