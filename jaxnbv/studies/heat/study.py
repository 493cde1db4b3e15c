"""The study of heat: how near does the coldest point of the scanned cloud come to the object's?"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.spatial import cKDTree

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.planning.episode import Step, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence, Grid, GridSurface, SDFSurface, TriangleMesh, mesh_from_sdf
from jaxnbv.scanning.sensors import HEAT_SETTING
from jaxnbv.search import HalvingSearch, Proposal
from jaxnbv.studies.engine.measures import Claim, Measure, Record
from jaxnbv.studies.engine.meshes import MeshStudy
from jaxnbv.studies.engine.study import RULES, Chart, Panel, Scene
from jaxnbv.studies.scenes import heat_scene
from jaxnbv.tasks import ColdestPoint, Coverage, body_temperature
from jaxnbv.tasks.diffusion import HeatProblem

# Those that seek cold; the other methods know nothing of heat.
HEAT_METHODS = ("heat", "heat-reached", "heat-halving")
_BASELINES = ("coverage", *RULES)
# The points among which a cloud's coldest is sought.
ESTIMATES = {"all": "coldest of all points", "reached": "coldest of the warmed points"}
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


def _saturated(record: Record, method: str) -> list[float | None]:
    """Whether every view had the value zero, for the methods that seek cold."""
    return [
        float(step["value"] == 0.0) if method in HEAT_METHODS else None for step in record["methods"][method]["steps"]
    ]


def _halving(quantity: str) -> Callable[[Record, str], list[float | None]]:
    """Of halving beside the full search, at the steps where there was something to find."""

    def of(record: Record, method: str) -> list[float | None]:
        run = record["methods"][method]
        asked = run.get("halving", [{quantity: np.nan}] * len(run["steps"]))
        pairs = zip(run["steps"], asked, strict=True)
        return [float(one[quantity]) if step["value"] > 0.0 else None for step, one in pairs]

    return of


def _seconds(record: Record, method: str) -> list[float]:
    return [float(np.median([step["seconds"] for step in record["methods"][method]["steps"]]))]


def _measures(estimate: str) -> tuple[Measure, ...]:
    def measure(name: str, title: str, of: Callable, unit: str, listed: bool = True) -> Measure:
        name, title = f"{name}, {estimate}", f"{title}:\n{ESTIMATES[estimate]}"
        return Measure(name, title, of, unit=unit, better="less", listed=listed)

    def of(quantity: str, record: Record, method: str) -> list[float]:
        return record["methods"][method]["estimates"][estimate][quantity]

    def error(record: Record, method: str) -> Float[np.ndarray, " views"]:
        return np.abs(np.array(of("temperatures", record, method)) - record["truth"]["temperature"])

    near, point = functools.partial(of, "distances"), functools.partial(of, "point_distances")
    return (
        measure("distance", "Distance to the coldest points", near, "scene units"),
        measure("point distance", "Distance to the very coldest point", point, "scene units", listed=False),
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
    reference: ClassVar[str] = "heat"
    measures: ClassVar[tuple[Measure, ...]] = (
        *_measures("all"),
        *_measures("reached"),
        Measure("saturated", "Saturated steps", _saturated, first=2, digits=2, paired=False),
        Measure("same", "Halving finds the view of the full search", _halving("same"), first=2, digits=2, paired=False),
        Measure("regret", "Value lost by halving", _halving("regret"), first=2, unit="degrees", paired=False),
        Measure("seconds", "Time of a proposal", _seconds, ("median",), "step", unit="seconds", digits=1),
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("The utility comes nearer to the coldest point within few views.", "distance, all", 4, _BASELINES),
    )
    charts: ClassVar[Mapping[str, Chart]] = {
        "coldest": Chart(tuple((Panel(f"distance, {e}"), Panel(f"error, {e}", log=True)) for e in ESTIMATES))
    }
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
        search = HalvingSearch(self.candidates) if method == "heat-halving" else self.search(method)
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

    def follow(
        self, scene: Scene, truth: Truth, method: str, methods: Sequence[str], episode: Iterator[Step]
    ) -> Record:
        """After each view the share of the points that the source warms and two estimates of the coldest point, one
        among all points and one among those (among all, where there are none): where it is, its temperature, its
        distance to the nearest of the object's coldest points, and that to the very coldest one.

        Of each step the value of the view that was chosen, zero if no view adds anything, and the seconds of the
        search. With "heat-halving" among the methods, each step of "heat" asks that search too.
        """
        halving = self.planner("heat-halving", scene) if method == "heat" and "heat-halving" in methods else None
        clouds, taken, compared = [], [], []
        for view, step in enumerate(episode):
            clouds.append(step.evidence.cloud)
            if (proposal := step.view.proposal) is not None:
                taken.append({"value": float(proposal.value), "seconds": step.seconds})
                if halving is not None and step.basis is not None:
                    key = view_keys(self.key(scene.index, "episode"), view)[1]
                    compared.append(_halved(halving, step.basis.evidence, step.basis.surfaces, key, proposal))
        run = {"steps": taken, **_estimates(clouds, heat_problem(scene), truth)}
        return run if halving is None else run | {"halving": compared}


def heat_problem(scene: Scene) -> HeatProblem:
    """The authors' problem, heated where the scene says."""
    return HeatProblem(np.asarray(scene.task))


def _halved(
    halving: Planner, evidence: Evidence, surfaces: GridSurface | None, key: PRNGKeyArray, full: Proposal
) -> Record:
    """Successive halving asked the same: whether it finds the view of the full search, how much less that values its
    own, and its seconds."""
    start = time.perf_counter()
    halved = jax.block_until_ready(halving.choose(evidence, surfaces, key))
    seconds, places = time.perf_counter() - start, np.asarray(full.candidates.position)
    found, best = (int(np.argmin(np.linalg.norm(places - one.pose.position, axis=1))) for one in (halved, full))
    return {"same": found == best, "regret": float(full.value - full.values[found]), "seconds": seconds}


def _estimates(clouds: Sequence[PointCloud], heat: HeatProblem, truth: Truth) -> Record:
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
