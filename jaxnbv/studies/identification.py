"""Study of identification: which known part an object is, and in which pose it lies."""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.loop import Sensor, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.programs import program
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import SensorNoise
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.search import Search, SphereCandidates
from jaxnbv.studies.engine.measures import KNOWN, SECONDS, Claim, Measure, Record
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.engine.tiles import ERRORS, ScenePicture, caption_tile, opposite_direction, render_mesh
from jaxnbv.studies.scenes.framing import Setup
from jaxnbv.studies.scenes.placed_parts import PlacedPart, confusable_parts, parts_in, place_part
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses
from jaxnbv.surfaces.placement import Placement
from jaxnbv.tasks import Identify, NewSurface
from jaxnbv.viz.style import DEVIATION

IDENTIFY, BY_NAME = "identify", "identify-name"
_LONGEST_SIDE = 2.5
# Sensor noise: 0.6 % of the longest side in each coordinate of a point, and six degrees in a normal.
_NOISE = SensorNoise(0.006 * _LONGEST_SIDE, 0.1)
# Lowest elevation of the cameras around a table.
_MIN_ELEVATION = math.radians(10.0)
# The part fills at least this fraction of a first view's pixels.
_MIN_SHOWN_FRACTION = 0.01
# Rows and columns of rays of an imagined scan.
_RAYS = (28, 28)
# Numbers of points on the true part and on the placed part between which distances are measured.
_NUM_POINTS, _NUM_DENSE_POINTS = 500, 20_000
# A pose is right if its error is below this fraction of the part's longest side.
_MAX_POSE_ERROR = 0.01
# Names count as tied if their weights are at least this fraction of the largest weight.
_TIE_RATIO = 0.99
_Truth = tuple[PlacedPart, Float[np.ndarray, "n 3"], float]


def _by_view(name: str) -> Any:
    return lambda record, method: [float(value) for value in record["methods"][method][name]]


def _below(fraction: float) -> Any:
    return lambda record, method: [float(value < fraction) for value in record["methods"][method]["add_s"]]


class IdentificationStudy(Study):
    """Measures how well a method's views tell which known part the object is, and in which pose it lies.

    All methods use the same bank, and compute the weights of its hypotheses in the same way. They differ only in the
    views that they choose. The study has the settings of `Study`, and:

    - `setup`: where the part lies, and how much of the part a view shows.
    - `meshes`: mesh files of the parts at true size. Without mesh files, the study uses sets of eight parts that look
      alike.
    """

    title: ClassVar[str] = "Which part it is, and how it lies"
    explanation: ClassVar[str] = (
        "Name right: the most likely name is the true name. 'None of these' counts as wrong. If n names are tied and\n"
        "the true name is one of them, the scene counts as 1/n.\n"
        "Pose right: the name is right, and the mean distance from the true part's surface to the placed part is\n"
        "below 1 % of the part's size.\n"
        "ADD-S: the mean distance from points of the true part to the nearest points of the placed part, as a\n"
        "fraction of the true part's diameter.\n"
        "There is no oracle, because scoring a candidate by its true scan needs a search of the bank."
    )
    methods: ClassVar[tuple[str, ...]] = (IDENTIFY, BY_NAME, "farthest", "random")
    extra_methods: ClassVar[tuple[str, ...]] = ("new-surface", "uncertainty")
    pictured: ClassVar[tuple[str, ...]] = (IDENTIFY, "farthest", "random")
    reference: ClassVar[str] = IDENTIFY
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure("right", "Name right", _by_view("right"), unit="%"),
        Measure("probability", "Probability of the true name", _by_view("p_true"), digits=2),
        Measure("placed", "Pose right", _by_view("placed"), unit="%"),
        Measure("add5", "ADD-S below 5 % of the diameter", _below(0.05), unit="%"),
        Measure("add10", "ADD-S below 10 % of the diameter", _below(0.1), unit="%"),
        SECONDS,
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim(
            "Views chosen to tell the hypotheses apart name the part sooner than views chosen without hypotheses.",
            "right",
            2,
            ("farthest", "random"),
        ),
    )
    without_bank: ClassVar[tuple[str, ...]] = ()
    seed: ClassVar[int] = 19
    quick: ClassVar[Mapping[str, Any]] = {
        "num_candidates": 24,
        "num_samples": 4,
        "grid_resolution": 48,
        "capacity": 1000,
    }

    num_candidates: int = eqx.field(static=True, default=60)
    num_samples: int = eqx.field(static=True, default=8)
    capacity: int = eqx.field(static=True, default=2000)
    setup: Setup = eqx.field(static=True, default=Setup.WHOLE)

    @classmethod
    def configured(
        cls,
        model: str,
        views: int,
        quick: bool,
        parts: str | Path | None = None,
        setup: Setup | None = None,
        **options: Any,
    ) -> dict[str, Study]:
        """Return one study for each setup, or only for `setup` if it is given. Keys are names of setups.

        - `parts`: folder of meshes at true size; default: the shipped sets of parts that look alike.

        **Raises:** `ValueError` if the model is not "known", or if the folder holds no meshes.
        """
        require(model == KNOWN, f"the study is about known parts: give the model {KNOWN}, or leave it out")
        settings: dict[str, Any] = {
            "sampler": SurfaceSampler.preset("screened", quick=quick),
            "meshes": () if parts is None else cls.files_in(parts),
        }
        settings |= (dict(cls.quick) if quick else {}) | options
        return {choice.value: cls(views=views, setup=choice, **settings) for choice in ((setup,) if setup else Setup)}

    @property
    def num_scenes(self) -> int | None:
        """None (unlimited), because a part can be placed in any number of poses."""
        return None

    @property
    def candidates(self) -> SphereCandidates:
        lowest = _MIN_ELEVATION if self.setup.is_resting else -0.5 * math.pi
        return SphereCandidates(self.num_candidates, self.setup.radius, lowest)

    @property
    def imagined_camera(self) -> Camera:
        return self.camera.resized(*_RAYS)

    def scene(self, index: int) -> Scene:
        """Return the scene of a part in a random pose. Its `task` is the `PlacedPart`.

        **Raises:** `ValueError` if the index is negative.
        """
        require(index >= 0, f"there is no scene {index}: scenes are counted from 0")
        if self.meshes:
            parts = parts_in(self.meshes)
            part = parts.choose(index)
        else:
            _, parts, part = confusable_parts(index)
        placed_part = place_part(parts, part, self.setup, self.key(index, "scene"))
        return Scene(index, parts.bank.names[part], placed_part.mesh, placed_part)

    def sensor(self, scene: Scene) -> Sensor:
        """Return a depth camera with noise on points, normals and ranges (distances along the rays).

        Obstacles may hide the part, and points on obstacles are removed from the scans.
        """
        obstacles = scene.task.obstacles

        def observe(pose: Pose, key: PRNGKeyArray) -> PointCloud:
            scan = observe_scene(scene.surface, self.camera, pose, _NOISE, key, obstacles)
            return scan if obstacles is None else obstacles.remove_points(scan)

        return observe

    def shows_enough(self, scene: Scene, scan: PointCloud) -> bool:
        return int(scan.count) >= _MIN_SHOWN_FRACTION * self.camera.num_rays

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """Return a sampler whose bank holds the parts in scene units. If there is a table, parts rest on it."""
        return self.sampler.with_bank(scene.task.bank, scene.task.poses)

    def planner_of(self, acquisition: Acquisition, search: Search, scene: Scene) -> Planner:
        planner = super().planner_of(acquisition, search, scene)
        return dataclasses.replace(planner, obstacles=scene.task.obstacles)

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        if method in ("new-surface", "uncertainty"):
            return NewSurface()
        return Identify(pose=method != BY_NAME)

    def truth(self, scene: Scene) -> _Truth:
        """Return the placed part, points on its surface, and its diameter (scene units)."""
        mesh = scene.task.mesh
        points = mesh.sample_points(self.key(scene.index, "measure"), _NUM_POINTS)
        return scene.task, points, float(pdist(mesh.to_trimesh().convex_hull.vertices).max())

    def scene_record(self, scene: Scene, truth: _Truth, first: int) -> Record:
        set_name = "" if self.meshes else scene.name.rpartition(" ")[0]
        return {"name": scene.name, "setup": self.setup.value, "set": set_name, "part": truth[0].part}

    @classmethod
    def group(cls, record: Record) -> str:
        """Return the name of the scene's set of look-alike parts; "" for parts from mesh files."""
        return record["set"]

    def follow(self, scene: Scene, truth: _Truth, planner: Planner, episode: Iterator[Step]) -> Record:
        """Record the likeliest name, the probability of the true name, and the pose's error after each view."""
        views = [self._view_record(truth, step.observations.hypotheses) for step in episode]
        return {name: [view[name] for view in views] for name in views[0]}

    def _view_record(self, truth: _Truth, hypotheses: Any) -> Record:
        assert isinstance(hypotheses, PartHypotheses)
        (task, points, diameter), bank = truth, hypotheses.bank
        weights = np.append(np.asarray(hypotheses.shape_weights), hypotheses.weights[-1])
        name_index, (part, placement) = int(np.argmax(weights)), hypotheses.most_likely
        # Scans may not distinguish some names yet. Count these as tied, or else their order in the bank would decide.
        is_tied = weights >= _TIE_RATIO * weights.max()
        correctness = float(is_tied[task.part] / is_tied.sum())
        rotation, shift = np.asarray(placement.rotation, np.float64), np.asarray(placement.shift, np.float64)
        distances = _distances(placement, bank.shape(jnp.asarray(part)).solid, jnp.asarray(points, jnp.float32))
        pose_error = float(np.mean(np.abs(np.asarray(distances)))) / _LONGEST_SIDE
        dense_points = task.placed_mesh(part, rotation, shift).sample_points(jax.random.key(0), _NUM_DENSE_POINTS)
        return {
            "named": NONE if name_index == len(bank) else bank.names[name_index],
            "right": correctness,
            "p_true": float(weights[task.part]),
            "fit": pose_error,
            "placed": correctness if pose_error < _MAX_POSE_ERROR else 0.0,
            "add_s": float(np.mean(cKDTree(dense_points).query(points)[0])) / diameter,
            "most_likely": {"part": part, "rotation": rotation.tolist(), "shift": shift.tolist()},
        }

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture:
        """Return a picture of the likeliest part after each view, coloured by its distance to the true part."""
        task, runs, eye = self.scene(record["scene"]).task, record["methods"], opposite_direction(record)
        true_mesh = task.mesh
        tree = cKDTree(true_mesh.sample_points(jax.random.key(0), 10 * _NUM_DENSE_POINTS))

        def tile(axes: Axes, method: str, view: int) -> None:
            run = runs[method]
            part, rotation, shift = (run["most_likely"][view][name] for name in ("part", "rotation", "shift"))
            mesh = task.placed_mesh(part, np.asarray(rotation), np.asarray(shift))
            axes.imshow(render_mesh(mesh, eye, pixels, lambda points: tree.query(points)[0]).image)
            caption_tile(axes, f"{run['named'][view]}, {run['p_true'][view]:.2f}", is_correct=run["right"][view] == 1)

        scale = ScalarMappable(ERRORS, DEVIATION), "distance to the true part\n(scene units)"
        caption = "The likeliest part as placed, its name, and the probability of the true name."
        return ScenePicture(
            caption, tile, lambda axes: axes.imshow(render_mesh(true_mesh, eye, pixels).image), scale=scale
        )


@program
def _distances(placement: Placement, solid: SignedDistance, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
    return placement.distance(solid, points)
