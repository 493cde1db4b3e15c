"""Base class of studies that count the views until all semantic parts of an object are found."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float, Int
from matplotlib.axes import Axes

from jaxnbv.acquisition import Acquisition, ExpectedUtilityImprovement
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, farthest_point_subsample
from jaxnbv.networks import CloudSegmenter
from jaxnbv.planning.loop import Step
from jaxnbv.planning.planner import Planner
from jaxnbv.programs import program
from jaxnbv.scanning import Grid, MeshParts, TriangleMesh
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.studies.engine.measures import Claim, Measure, Record
from jaxnbv.studies.engine.run import replay
from jaxnbv.studies.engine.searches import BASELINES
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.engine.tiles import ScenePicture, caption_tile, draw_on, opposite_direction, render_mesh
from jaxnbv.studies.sensors import PART_SETTING
from jaxnbv.tasks import Coverage, Segmenter, SoftPartCount, part_counts
from jaxnbv.viz.style import GREY, SERIES

# A part is found once the segmenter assigns N_target points to it. `TARGETS` are the values of N_target in the paper's
# Table 1, `TARGET` is the authors' value for the utility. Both are for a network that gets `NETWORK_POINTS` points.
TARGETS = (20, 40, 60, 80, 100)
TARGET, NETWORK_POINTS = 60, 2048
_BY_PARTS = ("discrete", "gradient-2dof", "gradient-6dof")
_OTHERS = (*BASELINES, "coverage")
# The width w of `NearestPart`, twice the standard deviation of the sensor noise.
_WIDTH = 0.02
# Distance of an absent part. It is so large that the part's probability and all derivatives are zero.
_ABSENT_DISTANCE = 100.0
# Number of points in pictures of the true surface.
_NUM_DENSE_POINTS = 8000


class NearestPart(Segmenter):
    """Oracle segmenter that knows the true parts, to evaluate planning without a network's errors.

    The probability that point i belongs to part c is

        p_ic proportional to exp(-d_ic^2 / 2 w^2),   w = 0.02 scene units,

    where d_ic is the distance of point i from the true part c. `of` adds absent parts, so that all objects have the
    same number of parts and share one compiled program.

    - `distances`: distance of each node of `grid` from each part, interpolated linearly between nodes.
    - `num_points`: number of points to segment. Farthest point sampling chooses them from the cloud.
    """

    distances: Float[Array, "parts g g g"]
    grid: Grid
    num_points: int = eqx.field(static=True)

    @classmethod
    def of(cls, parts: MeshParts, max_parts: int, grid: Grid, num_points: int) -> "NearestPart":
        """Make the oracle for the parts of a mesh, and add absent parts until there are `max_parts`."""
        distances = parts.distances(grid)
        padding = ((0, max_parts - len(distances)), (0, 0), (0, 0), (0, 0))
        return cls(jnp.pad(distances, padding, constant_values=_ABSENT_DISTANCE), grid, num_points)

    def __call__(self, cloud: PointCloud) -> Float[Array, "num_points parts"]:
        """Return the part probabilities of the `num_points` chosen points; zeros in rows without a point."""
        subsample = farthest_point_subsample(cloud, self.num_points)
        p = jax.nn.softmax(-0.5 * (self.distances_at(subsample.points) / _WIDTH) ** 2, axis=-1)
        return jnp.where(subsample.mask[:, None], p, 0.0)

    def predict(self, cloud: PointCloud) -> tuple[PointCloud, Int[Array, " num_points"]]:
        """Return the chosen points, and the index of the part nearest to each; -1 in rows without a point."""
        subsample = farthest_point_subsample(cloud, self.num_points)
        return subsample, jnp.where(subsample.mask, self.nearest(subsample.points), -1)

    def nearest(self, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        """Return the index of the part nearest to each point."""
        return jnp.argmin(self.distances_at(points), axis=-1).astype(jnp.int32)

    def distances_at(self, points: Float[Array, "n 3"]) -> Float[Array, "n parts"]:
        """Return the distance of each point from each part. A point outside the grid is moved to its border."""
        coordinates = list((points.T + self.grid.half_extent) / self.grid.spacing)

        def interpolate(values):
            return map_coordinates(values, coordinates, order=1, mode="nearest")

        return jax.vmap(interpolate, out_axes=-1)(self.distances)


PartSegmenter: TypeAlias = CloudSegmenter | NearestPart


def discovery_time(counts: Int[np.ndarray, "views parts"], target: int) -> int | None:
    """Return the paper's T_discovery: the first view, from 1, after which all parts have `target` points.

    Returns None if there is no such view. `counts` are the numbers of points assigned to each part after each view.
    """
    is_complete: Bool[np.ndarray, " views"] = np.all(np.asarray(counts) >= target, axis=1)
    return int(np.argmax(is_complete)) + 1 if is_complete.any() else None


def _discovery_times(record: Record, method: str) -> dict[int, float]:
    """Return `discovery_time` for each of `TARGETS`; the number of views plus one if it is None."""
    counts = np.asarray(record["methods"][method]["counts"])
    times = {target: discovery_time(counts, target) for target in TARGETS}
    return {target: float(record["study_views"] + 1 if time is None else time) for target, time in times.items()}


def _all_parts_found(record: Record, method: str) -> dict[int, float]:
    """Return, for each of `TARGETS`, 1.0 if all parts have that many points by the last view, else 0.0."""
    return {target: float(time <= record["study_views"]) for target, time in _discovery_times(record, method).items()}


def _all_parts_found_by_view(record: Record, method: str) -> list[float]:
    time = _discovery_times(record, method)[TARGET]
    return [float(time <= view) for view in range(1, record["study_views"] + 1)]


class PartDiscoveryStudy(Study):
    """Measures how many views it takes until a segmenter assigns enough points to every part.

    It has the settings of `Study`, and:

    - `imagined_rays`: rays along each side of an imagined scan. True scans have 64 x 64 rays.
    - `num_points`: number of points that the segmenter gets: the cloud and an imagined scan are joined and thinned to
      this number. The utility's N_target is scaled in proportion.
    """

    title: ClassVar[str] = "Views until all parts are found"
    explanation: ClassVar[str] = (
        "T_discovery for an N_target: number of views until the segmenter assigns N_target points to every part of\n"
        "the object. If a part never gets N_target points, T_discovery is set to the number of views plus one. The\n"
        "means are therefore lower bounds."
    )
    methods: ClassVar[tuple[str, ...]] = (*_BY_PARTS, *_OTHERS)
    pictured: ClassVar[tuple[str, ...]] = ("discrete", "gradient-2dof", "farthest", "uncertainty")
    reference: ClassVar[str] = "discrete"
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure(
            "time", "Views until all parts are found", _discovery_times, "N_target", "views", 2, lower_is_better=True
        ),
        Measure("found", "Objects whose parts were all found", _all_parts_found, "N_target", "%"),
        Measure("found_by_view", f"All parts found, N_target = {TARGET}", _all_parts_found_by_view, unit="%"),
    )
    claims: ClassVar[tuple[Claim, ...]] = tuple(
        Claim(f"The utility finds {target} points of every part in fewer views.", "time", target, _OTHERS)
        for target in (TARGET, max(TARGETS))
    )
    seed: ClassVar[int] = 6
    radius: ClassVar[float] = PART_SETTING.radius
    quick: ClassVar[Mapping[str, Any]] = {**Study.quick, "num_candidates": 24, "num_points": 512}
    paper: ClassVar[Mapping[str, Any]] = {**Study.paper, "num_points": NETWORK_POINTS, "imagined_rays": 64}

    views: int = eqx.field(static=True, default=6)
    num_samples: int = eqx.field(static=True, default=8)
    camera: Camera = PART_SETTING.camera
    imagined_rays: int = eqx.field(static=True, default=32)
    num_points: int = eqx.field(static=True, default=1024)

    @abstractmethod
    def segmenter_of(self, scene: Scene, num_points: int | None = None) -> PartSegmenter:
        """Return the segmenter for a scene and `num_points` points; default: as many as for true scans."""

    @abstractmethod
    def true_parts(self, scene: Scene, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        """Return the true part of each point of the surface, as an index of the segmenter's parts."""

    @property
    def imagined_camera(self) -> Camera:
        return Camera(height=self.imagined_rays, width=self.imagined_rays)

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        if method not in _BY_PARTS:
            return Coverage()
        target = TARGET * self.num_points / NETWORK_POINTS
        soft_count = SoftPartCount(self.segmenter_of(scene, self.num_points), target)
        return ExpectedUtilityImprovement(soft_count, self.num_points)

    def follow(self, scene: Scene, truth: list[int], planner: Planner, episode: Iterator[Step]) -> Record:
        """Record the number of points that the segmenter assigns to each part after each view.

        The episode ends once every part has as many points as the largest of `TARGETS`.
        """
        segmenter = self.segmenter_of(scene)
        counts: list[list[int]] = []
        for view, *_ in episode:
            counts.append(np.asarray(_count(segmenter, view.cloud))[truth].tolist())
            if min(counts[-1]) >= max(TARGETS):
                break
        return {"counts": counts}

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture:
        """Return a picture of the cloud after each view, coloured by predicted part, over the true shape."""
        scene, runs = self.scene(record["scene"]), record["methods"]
        parts, segmenter = np.asarray(self.truth(scene)), self.segmenter_of(scene)
        palette, point = [SERIES[part % len(SERIES)] for part in range(len(parts))], jnp.zeros((1, 3))
        num_labels = jax.eval_shape(segmenter, PointCloud(point, point, jnp.zeros(1, bool))).shape[1]
        colours = np.tile(mpl.colors.to_rgb(GREY), (num_labels, 1))
        colours[parts] = mpl.colors.to_rgba_array(palette)[:, :3]
        mesh = cast(TriangleMesh, true_mesh(scene.surface))
        points = mesh.sample_points(jax.random.key(0), _NUM_DENSE_POINTS)
        labels_of_points = np.asarray(self.true_parts(scene, jnp.asarray(points, jnp.float32)))
        rendering = render_mesh(mesh, opposite_direction(record), pixels)
        replays = {method: replay(self, scene, runs[method]) for method in methods}

        def tile(axes: Axes, method: str, view: int) -> None:
            cloud, labels = segmenter.predict(replays[method][view][1].cloud)
            mask = np.asarray(cloud.mask)
            draw_on(axes, rendering, np.asarray(cloud.points)[mask], colours[np.asarray(labels)[mask]])
            num_found = sum(count >= TARGET for count in runs[method]["counts"][view])
            caption_tile(axes, f"{num_found} of {len(parts)} parts", num_found == len(parts))

        marks = {name: {"marker": "o", "color": colour} for name, colour in zip(record["parts"], palette, strict=True)}
        caption = f"Points: predicted parts. Beneath: parts with {TARGET} points. All methods share view 1."
        return ScenePicture(
            caption, tile, lambda axes: draw_on(axes, rendering, points, colours[labels_of_points]), marks=marks
        )


@program
def _count(segmenter: PartSegmenter, cloud: PointCloud) -> Int[Array, " parts"]:
    return part_counts(segmenter(cloud))
