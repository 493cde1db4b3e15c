"""Study of heat: how near the coldest point of the scanned cloud is to the object's coldest points."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from scipy.spatial import cKDTree

from jaxnbv.acquisition import Acquisition, ExpectedUtilityImprovement
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.planning.loop import Step
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, TriangleMesh, mesh_from_sdf
from jaxnbv.search import Search
from jaxnbv.studies.engine.measures import SECONDS, Claim, Measure, Record
from jaxnbv.studies.engine.run import replay
from jaxnbv.studies.engine.searches import BASELINES
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.engine.tiles import ScenePicture, caption_tile, draw_on, opposite_direction, render_mesh
from jaxnbv.studies.scenes import heat_scene
from jaxnbv.studies.sensors import HEAT_SETTING
from jaxnbv.tasks import ColdestPoint, Coverage, body_temperature
from jaxnbv.tasks.diffusion import HeatProblem
from jaxnbv.viz.render import Still

# Methods whose utility is `ColdestPoint`.
HEAT_METHODS = ("heat", "heat-reached", "heat-halving")
_OTHERS = ("coverage", *BASELINES)
# Names of the two estimates of the coldest point, and the points of the cloud to which each is restricted.
ESTIMATES = {"all": "of all points", "reached": "of the warmed points"}
# Points count as coldest if their temperature exceeds the lowest by at most this fraction of the temperature range.
# Several may count, because objects have symmetries, and because the inner floor of a mug is equally cold.
_MAX_RELATIVE_EXCESS = 0.01
# Matplotlib's inferno without its palest colours, which would not stand out against the grey of unscanned surface.
_HEAT = LinearSegmentedColormap.from_list("heat", mpl.colormaps["inferno"](np.linspace(0.0, 0.9, 256)))
_MARKS: dict[str, dict[str, Any]] = {
    "heat source": {"marker": "X", "color": "#d55e00", "ms": 6.0, "mec": "white"},
    "coldest point of the object": {"marker": "*", "color": "#009e73", "ms": 10.0, "mec": "white"},
    "coldest point of the cloud": {"marker": "o", "color": "#0072b2", "ms": 5.5, "mec": "white"},
}


class Truth(NamedTuple):
    """The temperature (degrees) of the true object, at points at most 1/40 scene unit apart."""

    mesh: TriangleMesh
    points: Float[np.ndarray, "n 3"]
    temperatures: Float[np.ndarray, " n"]

    @property
    def coldest(self) -> Float[np.ndarray, "3"]:
        """The coldest point."""
        return self.points[np.argmin(self.temperatures)]

    @property
    def region(self) -> Float[np.ndarray, "m 3"]:
        """All points that count as coldest."""
        low, high = self.temperatures.min(), self.temperatures.max()
        return self.points[self.temperatures <= low + _MAX_RELATIVE_EXCESS * (high - low)]


def _saturation(record: Record, method: str) -> dict[int, float]:
    """Return, for each view from the second on, 1.0 if even the best candidate has value zero, else 0.0."""
    steps = record["methods"][method]["steps"] if method in HEAT_METHODS else []
    return {view: float(step["value"] == 0.0) for view, step in enumerate(steps, start=2)}


def _measures(estimate: str) -> tuple[Measure, ...]:
    def distances(record: Record, method: str) -> list[float]:
        return record["methods"][method]["estimates"][estimate]["distances"]

    def errors(record: Record, method: str) -> Float[np.ndarray, " views"]:
        temperatures = record["methods"][method]["estimates"][estimate]["temperatures"]
        return np.abs(np.array(temperatures) - record["truth"]["temperature"])

    title = f"Distance to the coldest points: {ESTIMATES[estimate]}"
    distance = Measure(f"distance, {estimate}", title, distances, unit="scene units", lower_is_better=True)
    title = f"Error of the lowest temperature: {ESTIMATES[estimate]}"
    return distance, Measure(f"error, {estimate}", title, errors, unit="degrees", lower_is_better=True)


class HeatStudy(Study):
    """Measures how near the coldest point of the cloud is to the object's coldest points.

    Meshes are heated at a random point. Procedural objects and their heat sources come from `heat_scene`. The study has
    the settings of `Study`, and:

    - `num_points`: number of points to which the cloud is thinned before an imagined scan is added. The temperature is
      simulated on both together.
    - `imagined_rays`: rays along each side of an imagined scan. True scans have 50 x 50 rays.
    - `true_grid`: grid on which a procedural object is meshed. The default resolves the thinnest rods (radius 0.04).
    """

    title: ClassVar[str] = "The coldest point"
    explanation: ClassVar[str] = (
        "The estimate is the coldest point of the cloud, among all points (as in the paper) or among the points that\n"
        "the heat source warms. The object's coldest points exceed its lowest temperature by at most 1 % of its\n"
        "temperature range. A step is saturated if every candidate has the value zero. The first candidate is then\n"
        "chosen. This happens if some points of the cloud are not connected to the heat source: they keep the initial\n"
        "temperature, which is the lowest, so that no view improves on it."
    )
    methods: ClassVar[tuple[str, ...]] = (*HEAT_METHODS, *_OTHERS)
    pictured: ClassVar[tuple[str, ...]] = ("heat", "heat-reached", *BASELINES)
    reference: ClassVar[str] = "heat"
    measures: ClassVar[tuple[Measure, ...]] = (
        *_measures("all"),
        *_measures("reached"),
        Measure("saturated", "Saturated steps", _saturation, unit="%", lower_is_better=True),
        SECONDS,
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("The heat utility gets nearer to the coldest point within few views.", "distance, all", 4, _OTHERS),
    )
    seed: ClassVar[int] = 8
    bank: ClassVar[str] = "heat"
    radius: ClassVar[float] = HEAT_SETTING.radius
    quick: ClassVar[Mapping[str, Any]] = {**Study.quick, "num_candidates": 24, "num_points": 512}
    quick_scenes: ClassVar[int] = 3
    paper: ClassVar[Mapping[str, Any]] = {
        **Study.paper,
        "views": 10,
        "num_candidates": 100,
        "capacity": 4096,
        "num_points": 4096,
        "imagined_rays": 50,
    }

    views: int = eqx.field(static=True, default=6)
    num_candidates: int = eqx.field(static=True, default=32)
    num_samples: int = eqx.field(static=True, default=8)
    num_points: int = eqx.field(static=True, default=1024)
    imagined_rays: int = eqx.field(static=True, default=24)
    true_grid: Grid = Grid(160)

    @property
    def imagined_camera(self) -> Camera:
        return Camera(height=self.imagined_rays, width=self.imagined_rays)

    def scene(self, index: int) -> Scene:
        """Return the scene with this index. Its `task` is the point where the object is heated."""
        file = self.mesh_file(index)
        if file is None:
            scene = heat_scene(index)
            return Scene(index, scene.name, scene.surface, scene.source)
        mesh = file.read()
        (source,) = mesh.sample_points(self.key(index, "scene"), 1)
        return Scene(index, file.name, mesh, jnp.asarray(source, jnp.result_type(float)))

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        if method not in HEAT_METHODS:
            return Coverage()
        coldest = ColdestPoint(scene.task, reached_only=method == "heat-reached")
        return ExpectedUtilityImprovement(coldest, self.num_points)

    def search(self, method: str, scene: Scene) -> Search:
        return super().search(method.removeprefix("heat-"), scene)

    def shows_enough(self, scene: Scene, scan: PointCloud) -> bool:
        """Return whether the scan shows the heat source."""
        points, _ = scan.to_numpy()
        return bool((np.linalg.norm(points - np.asarray(scene.task), axis=1) <= HeatProblem.radius).any())

    def truth(self, scene: Scene) -> Truth:
        """Return the temperature of the true surface.

        **Raises:** `ValueError` if the surface is neither a mesh nor a signed distance.
        """
        surface = scene.surface
        mesh = mesh_from_sdf(surface.sdf, self.true_grid) if isinstance(surface, SDFSurface) else surface
        if not isinstance(mesh, TriangleMesh):
            problem = f"the temperature of a {type(mesh).__name__} cannot be computed"
            raise InputError(f"{problem}: give a mesh or a signed distance")
        points, temperature = body_temperature(mesh, heat_problem(scene))
        return Truth(mesh, points, temperature.values)

    def scene_record(self, scene: Scene, truth: Truth, first: int) -> Record:
        low, high = float(truth.temperatures.min()), float(truth.temperatures.max())
        return {"name": scene.name, "truth": {"point": truth.coldest.tolist(), "temperature": low, "hottest": high}}

    def follow(self, scene: Scene, truth: Truth, planner: Planner, episode: Iterator[Step]) -> Record:
        """Record the fraction of warmed points and two estimates of the coldest point after each view.

        A point is warmed if it is connected to the heat source. The first estimate is the coldest of all points of the
        cloud. The second is the coldest of the warmed points, or of all points if none is warmed. Each estimate has a
        position, a temperature, and a distance to the nearest of the object's coldest points.
        """
        tree, heat, fractions = cKDTree(truth.region), heat_problem(scene), []
        quantities = ("points", "temperatures", "distances")
        estimates: dict[str, dict[str, list]] = {name: {key: [] for key in quantities} for name in ESTIMATES}
        for step in episode:
            points, temperature = body_temperature(step.observations.cloud, heat)
            fractions.append(float(temperature.reached.mean()))
            for name, lists in estimates.items():
                coldest = temperature.coldest(name == "reached" and bool(temperature.reached.any()))
                lists["points"].append(points[coldest].tolist())
                lists["temperatures"].append(float(temperature.values[coldest]))
                lists["distances"].append(float(tree.query(points[coldest])[0]))
        return {"reached": fractions, "estimates": estimates}

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture:
        """Return a picture of the cloud's visible points, coloured by temperature, over the object in grey."""
        scene, runs = self.scene(record["scene"]), record["methods"]
        truth, heat = self.truth(scene), heat_problem(scene)
        rendering = render_mesh(truth.mesh, opposite_direction(record), pixels)
        colours = ScalarMappable(Normalize(0.0, float(truth.temperatures.max())), _HEAT)
        replays = {method: replay(self, scene, runs[method]) for method in methods}

        def draw_truth(axes: Axes) -> None:
            draw_on(axes, rendering, truth.points, colours.to_rgba(truth.temperatures))
            _mark(axes, rendering, np.asarray(heat.source, np.float64), "heat source")
            _mark(axes, rendering, truth.coldest, "coldest point of the object")

        def tile(axes: Axes, method: str, view: int) -> None:
            _, observations = replays[method][view]
            points, temperature = body_temperature(observations.cloud, heat)
            draw_on(axes, rendering, points, colours.to_rgba(temperature.values))
            estimate = runs[method]["estimates"]["all"]
            _mark(axes, rendering, truth.coldest, "coldest point of the object")
            _mark(axes, rendering, np.array(estimate["points"][view]), "coldest point of the cloud")
            caption_tile(axes, f"{estimate['distances'][view]:.2f}")

        caption = "Scanned points, coloured by the temperature simulated on them. Beneath: error of the estimate."
        return ScenePicture(caption, tile, draw_truth, marks=_MARKS, scale=(colours, "temperature (degrees)"))


def heat_problem(scene: Scene) -> HeatProblem:
    """Return the paper's heat problem with the scene's heat source."""
    return HeatProblem(np.asarray(scene.task))


def _mark(axes: Axes, rendering: Still, point: Float[np.ndarray, "3"], name: str) -> None:
    """Draw the marker `name` at a point. The marker is hollow if the object hides the point."""
    pixels, in_front = rendering.project(point[None])
    look = _MARKS[name] if in_front[0] else _MARKS[name] | {"mfc": "white", "mec": _MARKS[name]["color"]}
    axes.plot(pixels[0, 0], pixels[0, 1], zorder=6, **look)
