"""Base class of studies, which defines their scenes, methods, measures and settings."""

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
from jaxnbv.planning.loop import Sensor, Step, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.readers.class_meshes import MeshFile, mesh_files
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SensorNoise, Surface
from jaxnbv.scanning.sensors import SENSOR_RADIUS
from jaxnbv.search import Candidates, Search, SphereCandidates
from jaxnbv.studies.engine.known import study_sampler, without_own_shape
from jaxnbv.studies.engine.measures import WITHOUT_BANK, Claim, Measure, Record
from jaxnbv.studies.engine.searches import search_of
from jaxnbv.studies.engine.tiles import ScenePicture

_PURPOSES = ("first", "episode", "scene", "measure")


class Scene(eqx.Module):
    """One object of a study.

    - `name`: name in tables and pictures; `surface`: true surface of the object.
    - `task`: other facts about the object, such as its heat source or its parts. The type depends on the study.
    """

    index: int
    name: str
    surface: Surface
    task: Any = None


class Study(eqx.Module):
    """Base class of studies, which compare methods of choosing views over many scenes.

    A new study defines the abstract members. Settings:

    - `views`: number of views, including the first.
    - `num_candidates`: number of candidate poses, on the sphere of `radius` (scene units). A gradient search evaluates
      half as many poses, spread over its own pose space, and starts from the best `num_starts` of these.
    - `sampler`, `capacity`: sampler of surfaces, and largest number of points of the cloud, as in `Planner`.
    - `num_samples`, `grid_resolution`: number of samples, and of the grid's nodes along each axis. Both replace the
      sampler's own settings.
    - `camera`: camera of the sensor. Imagined scans may have fewer rays, see `imagined_camera`.
    - `num_starts`, `iterations`, `learning_rate`: number of starts, number of steps from each start, and learning rate
      of gradient searches.
    - `meshes`: mesh files, one per scene. Without mesh files, the scenes are procedural.

    Class attributes:

    - `title`, `explanation`: texts above the tables.
    - `methods`: names of the methods, in order; `reference`: the method with which the others are compared.
    - `extra_methods`: methods that run only if a command names them.
    - `pictured`: methods in pictures; if empty, all methods.
    - `measures`: quantities in the tables and the chart; `claims`: claims to check, such as the paper's.
    - `quick`: settings of a quick run; `quick_scenes`: number of scenes of a quick run.
    - `paper`: settings of the paper and its code. An entry `views` replaces the default number of views in the study's
      `Entry`.
    - `seed`: seed of first views, noise and samples.
    - `bank`: name of the bank of known shapes, see `shape_bank`; "" for none.
    - `without_bank`: methods that run a second time without known shapes, under the name "METHOD-screened".

    **Raises:** `ValueError` if there are fewer than two views, or fewer candidates than views.
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
        """Return the studies that one command runs. Keys are names of subfolders, or "" for a single study.

        - `model`: name of the surface model. With the model `known` and `meshes`, the bank of each scene holds all
          meshes except the scene's own.
        - `quick`: whether to use the settings `Study.quick`.
        - `options`: other settings, which override `Study.quick`. `meshes` is a folder, see `files_in`, or the files.

        **Raises:** `ValueError` as `files_in` and `study_sampler` do.
        """
        meshes = options.pop("meshes", ())
        files = meshes if isinstance(meshes, tuple) else cls.files_in(meshes)
        settings = {"sampler": study_sampler(model, cls.bank, files, quick=quick), "meshes": files}
        return {"": cls(views=views, **settings | (dict(cls.quick) if quick else {}) | options)}

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        """Return the meshes in a folder that are usable as scenes.

        **Raises:** `ValueError` if there is no usable mesh.
        """
        return mesh_files(folder)

    @property
    def num_scenes(self) -> int | None:
        """Number of scenes; None if it is unlimited."""
        return len(self.meshes) or None

    @abstractmethod
    def scene(self, index: int) -> Scene:
        """Return the scene with this index.

        **Raises:** `ValueError` if there is no scene with this index, or if its file cannot be read.
        """

    def mesh_file(self, index: int) -> MeshFile | None:
        """Return the mesh file of the scene with this index, or None if the scenes are procedural.

        **Raises:** `ValueError` if there is no scene with this index.
        """
        count = len(self.meshes)
        require(
            count == 0 or 0 <= index < count,
            f"there is no scene {index}: the study has {count} meshes, counted from 0; run at most {count} scenes",
        )
        return self.meshes[index] if count else None

    @abstractmethod
    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        """Return a method's acquisition. It compiles only once if all scenes give the same pytree structure."""

    def search(self, method: str, scene: Scene) -> Search:
        """Return the search of a method, see `search_of`."""
        sizes = self.num_candidates, self.radius, self.num_starts, self.iterations
        return search_of(method, self.candidates, *sizes, self.learning_rate)

    def planner(self, method: str, scene: Scene) -> Planner:
        """Return the planner of a method, without known shapes if the name ends in "-screened"."""
        name = method.removesuffix(WITHOUT_BANK)
        planner = self.planner_of(self.acquisition(name, scene), self.search(name, scene), scene)
        if name == method:
            return planner
        return dataclasses.replace(planner, sampler=planner.sampler.without_bank)

    def truth(self, scene: Scene) -> Any:
        """Return the ground truth of a scene, by default `scene.task`. It is computed once for all methods."""
        return scene.task

    @abstractmethod
    def follow(self, scene: Scene, truth: Any, planner: Planner, episode: Iterator[Step]) -> Record:
        """Run an episode and return its record, which must be JSON-serialisable.

        - `truth`: the scene's `truth`.
        - `episode`: iterator that runs one step at a time. `follow` may stop before the iterator ends.
        """

    def scene_record(self, scene: Scene, truth: Any, first: int) -> Record:
        """Return the facts about the scene that its record stores, which must be JSON-serialisable.

        - `truth`: the scene's `truth`; `first`: index of the first view among the candidates.
        """
        return {"name": scene.name}

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture | None:
        """Return the picture of a scene as a grid of small images; None if the study has no pictures.

        - `methods`: methods to show, one per row; `pixels`: width and height of each image.
        """
        return None

    def sensor(self, scene: Scene) -> Sensor:
        """Return the simulated sensor that scans the scene."""
        return lambda pose, key: observe_scene(scene.surface, self.camera, pose, SensorNoise(), key)

    def shows_enough(self, scene: Scene, scan: PointCloud) -> bool:
        """Return whether a scan shows enough of the object to be the first scan of an episode."""
        return bool(scan.mask.any())

    @classmethod
    def group(cls, record: Record) -> str:
        """Return the name of the group to which the scene belongs; "" for none. Each group has its own tables."""
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
        """The camera of imagined scans, by default the sensor's."""
        return self.camera

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """Return the sampler for a scene. A bank made from `meshes` leaves out the scene's own mesh."""
        return without_own_shape(self.sampler, self.meshes, scene.index) if self.meshes else self.sampler

    def planner_of(self, acquisition: Acquisition, search: Search, scene: Scene) -> Planner:
        """Return a planner with the study's settings and the sampler of the scene."""
        base = self.sampler_of(scene)
        sampler = dataclasses.replace(base, grid=self.grid, num_samples=self.num_samples)
        settings = acquisition, search, self.imagined_camera, sampler
        return Planner(*settings, capacity=self.capacity, max_views=self.views)

    def key(self, index: int, purpose: str) -> PRNGKeyArray:
        """Return a random key that depends only on the study's seed, the scene's index and the purpose.

        - `purpose`: "first" (first view), "episode", "scene" or "measure".
        """
        scene_key = jax.random.fold_in(jax.random.key(self.seed), index)
        return jax.random.fold_in(scene_key, _PURPOSES.index(purpose))

    def episode_keys(self, method: str, scene: Scene) -> list[PRNGKeyArray]:
        """Return one random key per episode of a method; by default one key, which all methods share."""
        return [self.key(scene.index, "episode")]

    def merge_runs(self, runs: Sequence[Record]) -> Record:
        """Merge the records of a method's episodes, one per key of `episode_keys`, into one record."""
        return runs[0]

    def first_view(self, scene: Scene) -> int:
        """Return the index of a random candidate whose scan shows enough of the object, see `shows_enough`.

        **Raises:** `ValueError` if no candidate shows enough.
        """
        poses, sensor = self.candidates.poses(), self.sensor(scene)
        *_, noise_key = view_keys(self.key(scene.index, "episode"), 0)
        order = jax.random.permutation(self.key(scene.index, "first"), poses.position.shape[0]).tolist()
        for index in order:
            if self.shows_enough(scene, sensor(poses[index], noise_key)):
                return index
        raise InputError(f"none of {self.num_candidates} candidates shows enough of {scene.name}: ask for more")
