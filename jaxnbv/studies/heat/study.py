"""The study of heat: how near does the coldest point of the scanned cloud come to the object's?"""

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.planning.episode import Step
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, TriangleMesh, mesh_from_sdf
from jaxnbv.scanning.sensors import HEAT_SETTING
from jaxnbv.studies.engine.measures import SECONDS, Claim, Measure, Record
from jaxnbv.studies.engine.meshes import MeshStudy
from jaxnbv.studies.engine.searches import RULES
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.scenes import heat_scene
from jaxnbv.tasks import ColdestPoint, Coverage, body_temperature
from jaxnbv.tasks.diffusion import HeatProblem

# Those that seek cold; the other methods know nothing of heat.
HEAT_METHODS = ("heat", "heat-reached", "heat-halving")
_BASELINES = ("coverage", *RULES)
# The points among which a cloud's coldest is sought.
ESTIMATES = {"all": "of all points", "reached": "of the warmed points"}
# Points colder than this share of the range of temperatures count as coldest: objects have symmetries, and the inner
# floor of a mug is as cold all over.
_NEARLY = 0.01


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


def _saturated(record: Record, method: str) -> dict[int, float]:
    """Whether every view had the value zero, for the methods that seek cold."""
    taken = record["methods"][method]["steps"] if method in HEAT_METHODS else []
    return {view: float(step["value"] == 0.0) for view, step in enumerate(taken, start=2)}


def _measures(estimate: str) -> tuple[Measure, ...]:
    def measure(name: str, title: str, of: Callable, unit: str) -> Measure:
        return Measure(f"{name}, {estimate}", f"{title}: {ESTIMATES[estimate]}", of, unit=unit, less=True)

    def of(quantity: str, record: Record, method: str) -> list[float]:
        return record["methods"][method]["estimates"][estimate][quantity]

    def error(record: Record, method: str) -> Float[np.ndarray, " views"]:
        return np.abs(np.array(of("temperatures", record, method)) - record["truth"]["temperature"])

    return (
        measure("distance", "Distance to the coldest points", functools.partial(of, "distances"), "scene units"),
        measure("error", "Error of the lowest temperature", error, "degrees"),
    )


class HeatStudy(MeshStudy):
    """How near the coldest point of the cloud comes to the object's coldest points. Settings as of `MeshStudy`, and

    - `num_points`: points of D to which imagined scans are added, where the temperature is simulated.
    - `imagined_rays`: rays along a side of an imagined scan; true scans have 50 x 50.
    - `true_grid`: of the mesh of a procedural object; the default is fine enough for the thinnest rods, of radius 0.04.

    A mesh is heated at a random point; procedural objects are those of `heat_scene`.
    """

    title: ClassVar[str] = "The coldest point"
    explanation: ClassVar[str] = (
        "The estimate is the coldest of all points of the cloud, as in the paper, or of those that the source warms.\n"
        "The object's coldest points are those within 1 % of its range of temperatures of the lowest. Saturated are\n"
        "steps at which every view had the value zero: the first candidate is taken then. The lowest temperature is\n"
        "already that before heating, at a piece of the cloud that is not connected to the source."
    )
    methods: ClassVar[tuple[str, ...]] = (*HEAT_METHODS, *_BASELINES)
    pictured: ClassVar[tuple[str, ...]] = ("heat", "heat-reached", *RULES)
    reference: ClassVar[str] = "heat"
    measures: ClassVar[tuple[Measure, ...]] = (
        *_measures("all"),
        *_measures("reached"),
        Measure("saturated", "Saturated steps", _saturated, unit="%", less=True),
        SECONDS,
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("The utility comes nearer to the coldest point within few views.", "distance, all", 4, _BASELINES),
    )
    seed: ClassVar[int] = 8
    radius: ClassVar[float] = HEAT_SETTING.radius
    quick: ClassVar[Mapping[str, Any]] = {**MeshStudy.quick, "num_candidates": 24, "num_points": 512}
    quick_scenes: ClassVar[int] = 3

    views: int = eqx.field(static=True, default=6)
    num_candidates: int = eqx.field(static=True, default=32)
    num_samples: int = eqx.field(static=True, default=8)
    num_points: int = eqx.field(static=True, default=1024)
    imagined_rays: int = eqx.field(static=True, default=24)
    true_grid: Grid = Grid(160)

    bank: ClassVar[str] = "heat"
    unknowing: ClassVar[tuple[str, ...]] = ("coverage", "uncertainty")

    def procedural(self, index: int) -> Scene:
        made = heat_scene(index)
        return Scene(index, made.name, made.surface, made.source)

    def task_of(self, mesh: TriangleMesh, index: int) -> Float[Array, "3"]:
        """The point where it is heated."""
        (source,) = mesh.sample_points(self.key(index, "scene"), 1)
        return jnp.asarray(source, jnp.result_type(float))

    def planner(self, method: str, scene: Scene) -> Planner:
        search = self.search(method.removeprefix("heat-"))
        camera = Camera(height=self.imagined_rays, width=self.imagined_rays)
        if method not in HEAT_METHODS:
            return self.planner_of(Coverage(), search, scene, camera)
        coldest = ColdestPoint(scene.task, reached_only=method == "heat-reached")
        return self.planner_of(ExpectedUtilityImprovement(coldest, self.num_points), search, scene, camera)

    def shows_enough(self, scene: Scene, seen: PointCloud) -> bool:
        """The heat source must be seen."""
        points, _ = seen.to_numpy()
        return bool((np.linalg.norm(points - np.asarray(scene.task), axis=1) <= HeatProblem.radius).any())

    def truth(self, scene: Scene) -> Truth:
        surface = scene.surface
        mesh = mesh_from_sdf(surface.sdf, self.true_grid) if isinstance(surface, SDFSurface) else surface
        if not isinstance(mesh, TriangleMesh):
            raise InputError(
                f"the temperature of a {type(mesh).__name__} is not known: give a mesh or a signed distance"
            )
        points, temperature = body_temperature(mesh, heat_problem(scene))
        return Truth(mesh, points, temperature.values)

    def facts(self, scene: Scene, truth: Truth, first: int) -> Record:
        low, high = float(truth.temperatures.min()), float(truth.temperatures.max())
        return {"name": scene.name, "truth": {"point": truth.coldest.tolist(), "temperature": low, "hottest": high}}

    def follow(self, scene: Scene, truth: Truth, planner: Planner, episode: Iterator[Step]) -> Record:
        """After each view the share of the points that the source warms and two estimates of the coldest point, one
        among all points and one among those (among all, where there are none): where it is, its temperature, and its
        distance to the nearest of the object's coldest points."""
        tree, heat, shares = cKDTree(truth.region), heat_problem(scene), []
        lists = ("points", "temperatures", "distances")
        estimates: dict[str, dict[str, list]] = {name: {key: [] for key in lists} for name in ESTIMATES}
        for step in episode:
            points, temperature = body_temperature(step.evidence.cloud, heat)
            shares.append(float(temperature.reached.mean()))
            for name, into in estimates.items():
                coldest = temperature.coldest(name == "reached" and bool(temperature.reached.any()))
                into["points"].append(points[coldest].tolist())
                into["temperatures"].append(float(temperature.values[coldest]))
                into["distances"].append(float(tree.query(points[coldest])[0]))
        return {"reached": shares, "estimates": estimates}


def heat_problem(scene: Scene) -> HeatProblem:
    """The authors' problem, heated where the scene says."""
    return HeatProblem(np.asarray(scene.task))
