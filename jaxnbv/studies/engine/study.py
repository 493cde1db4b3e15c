"""What a study is, and the engine that runs one scene of it with every method."""

import dataclasses
import itertools
import time
import traceback
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, check_type, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Sensor, Step, scene_sensor, steps, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence, Grid, Surface
from jaxnbv.scanning.sensors import SENSOR_RADIUS
from jaxnbv.search import (
    Candidates,
    CandidateSearch,
    DiscreteSearch,
    FarthestView,
    RandomView,
    Search,
    SphereCandidates,
    UncertaintyView,
)
from jaxnbv.studies.engine.measures import KNOWN, UNKNOWING, Claim, Measure, Record
from jaxnbv.studies.scenes.banks import bank_poses, shape_bank

_PURPOSES = ("first", "episode", "scene", "measure")
# The baselines of all studies that look at no acquisition.
RULES: dict[str, type[CandidateSearch]] = {
    "farthest": FarthestView,
    "uncertainty": UncertaintyView,
    "random": RandomView,
}


class Scene(eqx.Module):
    """One object under study.

    - `name`: in tables and pictures.
    - `task`: what else the study knows of it: where it is heated, which parts it has.
    """

    index: int
    name: str
    surface: Surface
    task: Any = None


class Panel(NamedTuple):
    """One panel of a chart: a measure by its name; a title and a label of the axis in place of the measure's."""

    measure: str
    title: str = ""
    axis: str = ""
    log: bool = False


class Chart(NamedTuple):
    """Rows of panels; or one row for each group of scenes."""

    rows: tuple[tuple[Panel, ...], ...]
    by_group: bool = False


class Study(eqx.Module):
    """What all scenes of a study share, and what it measures. A new study says what is left open here.

    Settings:

    - `views`: in all, the first included.
    - `num_candidates`: on the sphere of `radius`, at which every search but those by gradient looks.
    - `imagination`, `num_samples`, `grid_resolution`, `capacity`: of the planner; the imagination has as many samples
      on a grid of this resolution.
    - `camera`: the sensor; a planner may imagine fewer rays.

    What it is:

    - `title`, `explanation`: for tables.
    - `methods`: by name, in order; `reference`: the one that the others are compared with.
    - `measures`, `charts`: what tables and figures show; charts by the names of their files.
    - `claims`: what the paper says of it.
    - `quick`: settings for a first look, on `quick_scenes` scenes.
    - `seed`: of its first views, noise and samples.
    - `bank`: of the shapes that are known, see `shape_bank`; "" for none.
    - `unknowing`: those of the methods that are run once more by one who knows none, as "METHOD-screened".

    **Raises:** `ValueError` for fewer than two views, or fewer candidates than views.
    """

    title: eqx.AbstractClassVar[str]
    explanation: eqx.AbstractClassVar[str]
    methods: eqx.AbstractClassVar[tuple[str, ...]]
    reference: eqx.AbstractClassVar[str]
    measures: eqx.AbstractClassVar[tuple[Measure, ...]]
    charts: eqx.AbstractClassVar[Mapping[str, Chart]]
    seed: eqx.AbstractClassVar[int]
    claims: ClassVar[tuple[Claim, ...]] = ()
    radius: ClassVar[float] = SENSOR_RADIUS
    quick: ClassVar[Mapping[str, Any]] = {"num_samples": 4, "grid_resolution": 48, "capacity": 1024}
    quick_scenes: ClassVar[int] = 4
    bank: ClassVar[str] = ""
    unknowing: ClassVar[tuple[str, ...]] = ()

    views: int = eqx.field(static=True, default=5)
    num_candidates: int = eqx.field(static=True, default=48)
    num_samples: int = eqx.field(static=True, default=16)
    imagination: Imagination = eqx.field(default_factory=Imagination)
    grid_resolution: int = eqx.field(static=True, default=64)
    capacity: int = eqx.field(static=True, default=4096)
    camera: Camera = Camera()

    def __check_init__(self):
        require(
            2 <= self.views <= self.num_candidates,
            f"the study has {self.views} views of {self.num_candidates} candidates; ask for at least two views, and "
            "for as many candidates",
        )

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> "dict[str, Study]":
        """The study that a command asks for, or several by the names of their folders; of one alone the name is "".

        - `options`: settings of its own.
        """
        imagined = {"imagination": cls.imagined(model, quick=quick)}
        return {"": cls(views=views, **imagined | (dict(cls.quick) if quick else {}) | options)}

    @classmethod
    def imagined(cls, model: str, longest_side: float = 2.5, quick: bool = False, solid: bool = False) -> Imagination:
        """As `Imagination.preset`, or for the model `known` the screened one that knows the shapes of `bank`.

        **Raises:** `ValueError` for another model, or `known` where there is no bank.
        """
        if model != KNOWN:
            return Imagination.preset(model, longest_side, quick, solid=solid)
        require(bool(cls.bank), f"there are no known shapes for {cls.title.lower()}: give another model")
        plain = Imagination.preset("screened", longest_side, quick, solid=solid)
        return plain.knowing(shape_bank(cls.bank), bank_poses(cls.bank))

    @classmethod
    def all_methods(cls, model: str) -> tuple[str, ...]:
        """The methods, and where shapes are known those of `unknowing`."""
        again = (f"{name}{UNKNOWING}" for name in cls.unknowing) if model == KNOWN else ()
        return (*cls.methods, *again)

    @property
    def num_scenes(self) -> int | None:
        """How many scenes there are; None for as many as are asked for."""
        return None

    @abstractmethod
    def scene(self, index: int) -> Scene:
        """A scene.

        **Raises:** `ValueError` if there is none of this index, or it cannot be read.
        """

    @abstractmethod
    def planner(self, method: str, scene: Scene) -> Planner:
        """The planner of one of `methods`; scenes share compilations."""

    def planner_for(self, method: str, scene: Scene) -> Planner:
        """The planner of a method, of one that knows no shapes too."""
        planner = self.planner(method.removesuffix(UNKNOWING), scene)
        if not method.endswith(UNKNOWING):
            return planner
        return dataclasses.replace(planner, imagination=planner.imagination.unknowing)

    @abstractmethod
    def truth(self, scene: Scene) -> Any:
        """What is measured against, computed once a scene."""

    @abstractmethod
    def follow(self, scene: Scene, truth: Any, method: str, methods: Sequence[str], episode: Iterator[Step]) -> Record:
        """What is recorded of a method's episode, as JSON; it may stop early.

        - `methods`: all that are run on the scene.
        """

    def facts(self, scene: Scene, truth: Any, first: int) -> Record:
        """What is recorded of the scene itself, as JSON."""
        return {"name": scene.name}

    def sensor(self, scene: Scene) -> Sensor:
        """What the camera sees of a scene."""
        return scene_sensor(scene.surface, self.camera)

    def shows_enough(self, scene: Scene, seen: PointCloud) -> bool:
        """Whether a scan can be the first one."""
        return bool(seen.mask.any())

    @classmethod
    def groups(cls, records: Sequence[Record]) -> dict[str, list[Record]]:
        """All records, and parts of them that are told apart."""
        return {"all": list(records)}

    @classmethod
    def measure(cls, name: str) -> Measure:
        """One of `measures`."""
        (found,) = (measure for measure in cls.measures if measure.name == name)
        return found

    @property
    def remedy(self) -> str:
        """What to do where no candidate can be the first one."""
        return "give more"

    @property
    def candidates(self) -> Candidates:
        """Where the sensor can stand."""
        return SphereCandidates(self.num_candidates, self.radius)

    @property
    def grid(self) -> Grid:
        """Where samples are evaluated."""
        return Grid(self.grid_resolution)

    def search(self, method: str) -> Search:
        """Over the candidates: one of `RULES`, or the full search by the acquisition."""
        return RULES.get(method, DiscreteSearch)(self.candidates)

    def imagination_of(self, scene: Scene) -> Imagination:
        """The study's, or what is known of such a scene."""
        return self.imagination

    def planner_of(
        self,
        acquisition: Acquisition,
        search: Search,
        scene: Scene,
        camera: Camera | None = None,
    ) -> Planner:
        """A planner with the study's settings, and what is known of such a scene.

        - `camera`: whose scans are imagined, by default the sensor.
        """
        known = self.imagination_of(scene)
        imagination = dataclasses.replace(known, grid=self.grid, num_samples=self.num_samples)
        planned = acquisition, search, camera or self.camera, imagination
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

        **Raises:** `ValueError` for an unknown method, as `scene` does, if no candidate shows enough, or if one
        of `own` makes no planner of so many views.
        """
        known = self.all_methods(KNOWN)
        methods = self.methods if methods is None else tuple(methods)
        unknown = sorted({*methods} - {*known})
        require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(known)}")
        start = time.perf_counter()
        scene = self.scene(index)
        planners = {name: self._made(name, make, scene) for name, make in (own or {}).items()}
        first, truth = self.first_view(scene), self.truth(scene)
        record = {"scene": index, **self.facts(scene, truth, first), "first": first, "study_views": self.views}
        record["methods"] = self.run_methods(scene, truth, first, methods) | {
            name: self.run(scene, truth, first, name, methods, planner) for name, planner in planners.items()
        }
        return record | {"seconds": time.perf_counter() - start}

    def _made(self, name: str, make: "Factory", scene: Scene) -> Planner:
        """The planner of a method of one's own."""
        try:
            planner = make(self, scene)
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            problem = f"{type(error).__name__}: {error}, {where.filename}:{where.lineno}"
            raise InputError(f"the method {name} fails on scene {scene.index} ({problem})") from error
        check_type(planner, Planner, f"what the method {name} makes")
        require(
            planner.max_views >= self.views,
            f"the method {name} makes a planner of {planner.max_views} views, but the study has {self.views}: give "
            f"Planner(max_views={self.views})",
        )
        return planner

    def run_methods(self, scene: Scene, truth: Any, first: int, methods: Sequence[str]) -> dict[str, Record]:
        """The records of the study's own methods."""
        return {name: self.run(scene, truth, first, name, methods, self.planner_for(name, scene)) for name in methods}

    def run(
        self, scene: Scene, truth: Any, first: int, method: str, methods: Sequence[str], planner: Planner
    ) -> Record:
        """The record of one method: its views' poses, and what `follow` makes of its episode."""
        views: list[dict[str, list]] = []

        def noted() -> Iterator[Step]:
            first_pose, key = self.candidates.poses()[first], self.key(scene.index, "episode")
            for step in itertools.islice(steps(planner, self.sensor(scene), first_pose, key, self.camera), self.views):
                views.append(pose_record(step.view.pose))
                yield step

        return {"views": views, **self.follow(scene, truth, method, methods, noted())}

    def first_view(self, scene: Scene) -> int:
        """A random one of the candidates from which the object shows enough."""
        poses, sensor = self.candidates.poses(), self.sensor(scene)
        *_, noise_key = view_keys(self.key(scene.index, "episode"), 0)
        for candidate in jax.random.permutation(self.key(scene.index, "first"), self.num_candidates).tolist():
            if self.shows_enough(scene, sensor(poses[candidate], noise_key)):
                return candidate
        raise InputError(f"none of {self.num_candidates} candidates shows enough of {scene.name}: {self.remedy}")

    def seen(self, scene: Scene, run: Record) -> list[tuple[PointCloud, Evidence]]:
        """Each scan of a method, and the evidence after it, made again from the poses of its record."""
        key, sensor = self.key(scene.index, "episode"), self.sensor(scene)
        poses = self.poses_of(run)
        require(len(poses) > 0, "there are no views to scan again")
        views = [(pose, sensor(pose, view_keys(key, index)[2]), self.camera) for index, pose in enumerate(poses)]
        # It depends on the planner through its capacity and what it carves alone.
        known = self.planner(self.methods[0], scene).replay(views)
        return [(scan, evidence) for (_, scan, _), evidence in zip(views, known, strict=True)]

    def poses_of(self, run: Record) -> list[Pose]:
        """Where a method's views were taken."""
        arrays = [[np.asarray(view[name], np.float32) for name in ("rotation", "position")] for view in run["views"]]
        return [Pose(rotation, position) for rotation, position in arrays]


def pose_record(pose: Pose) -> Record:
    """A pose as JSON."""
    return {"position": pose.position.tolist(), "rotation": pose.rotation.tolist()}


# A method of one's own: the planner of a scene.
Factory: TypeAlias = Callable[[Study, Scene], Planner]
