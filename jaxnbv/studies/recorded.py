"""Study of a recording: how much of a box is shown by the frames that a method chooses."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from matplotlib.axes import Axes

from jaxnbv.acquisition import Acquisition
from jaxnbv.checks import InputError, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.images import stride_of
from jaxnbv.planning.loop import Sensor, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.readers.recorded import RecordedFrames
from jaxnbv.sampler import MODELS, SurfaceSampler
from jaxnbv.scanning import Surface
from jaxnbv.scanning.scanner import Hits
from jaxnbv.search import GivenPoses, Problem, Search
from jaxnbv.search.base import Baseline
from jaxnbv.studies.engine.measures import Claim, Measure, Record
from jaxnbv.studies.engine.searches import BASELINES
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.engine.tiles import ScenePicture, caption_tile
from jaxnbv.studies.shown_voxels import Recording, bounds_of, frame_of_box, read_recording
from jaxnbv.tasks import Coverage, NewSurface
from jaxnbv.utility import Quantity
from jaxnbv.viz.style import GREY, INK, LINE, NEW

NEW_AREA, COVERAGE, EVEN, ORACLE = "new surface", "coverage", "evenly spaced", "oracle"
_VOXELS_ALONG_BOX = 80
# Smallest fraction of the box's voxels that a first view shows.
_MIN_SHOWN_FRACTION = 0.05
# Rows and columns of rays of an imagined scan.
_RAYS = (24, 32)


class _UnknownSurface(Surface):
    """Placeholder for the true surface of a recording, which is unknown."""

    in_jit: ClassVar[bool] = False

    def trace(self, origins, directions) -> Hits:
        raise InputError("the true surface of a recording is unknown: take scans from the study's sensor")


class FixedOrder(Baseline):
    """Baseline that visits candidates in the order of the indices `order`, starting with the first view."""

    order: Int[Array, " views"] = eqx.field(kw_only=True)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Return 1 for the next candidate in the order, and 0 for all others."""
        is_next = jnp.arange(candidates.position.shape[0]) == self.order[problem.observations.num_views]
        return is_next.astype(candidates.position.dtype)


class MostNewVoxels(Baseline):
    """Greedy oracle that chooses the frame with the most voxels that no frame chosen before shows.

    - `is_shown`: entry (i, j) is True if candidate i shows voxel j.
    """

    is_shown: Bool[Array, "candidates voxels"] = eqx.field(kw_only=True)

    def quantity(self, acquisition: Acquisition) -> Quantity:
        return Quantity("new voxels", "", "voxels that a frame shows and no earlier frame does.", smooth=False)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        """Return, for each candidate, the number of voxels that it shows and no visited candidate shows."""
        is_shown = jnp.any(self.is_shown & problem.observations.poses.contains(candidates)[:, None], axis=0)
        gain = jnp.sum(self.is_shown & ~is_shown, axis=1)
        return gain.astype(candidates.position.dtype)


def _gain_over_oracle(record: Record, method: str) -> dict[int, float | None]:
    """Return a method's gain in voxels since view 1, divided by the oracle's gain, at each later view.

    The ratio is None if the oracle has gained no voxels. Without a run of the oracle, the result is {}.
    """
    if ORACLE not in record["methods"]:
        return {}
    fractions, oracle_fractions = (record["methods"][name]["covered"] for name in (method, ORACLE))
    gains, oracle_gains = (np.subtract(values[1:], values[0]).tolist() for values in (fractions, oracle_fractions))
    pairs = enumerate(zip(gains, oracle_gains, strict=True), start=2)
    return {view: gain / oracle_gain if oracle_gain > 0 else None for view, (gain, oracle_gain) in pairs}


class RecordedStudy(Study):
    """Measures how much of a box is shown by the frames that a method chooses from a recording.

    The candidates are the recorded poses with their recorded scans. The first view is a random frame that shows at
    least 5 % of the box's voxels. Scenes differ only in their first view. The study has the settings of `Study`, and:

    - `folder`, `up`, `intrinsics` (fx, fy, cx, cy), `depth_scale`: arguments of `RecordedFrames`.
    - `box`: the region of interest, in the recording's units.
    - `voxel`: side of the counted voxels, in the recording's units.

    **Raises:** `ValueError` as `read_recording` does, when `recording` is first read.
    """

    title: ClassVar[str] = "Voxels of a recorded place that were seen"
    explanation: ClassVar[str] = (
        "Fraction of the box's voxels that the chosen frames show. Only voxels that at least three frames show count.\n"
        "The oracle chooses the frame that shows the most new voxels. Evenly spaced frames divide the recording into\n"
        "equal intervals."
    )
    methods: ClassVar[tuple[str, ...]] = (NEW_AREA, COVERAGE, *BASELINES, EVEN, ORACLE)
    reference: ClassVar[str] = NEW_AREA
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure("covered", "Voxels seen", lambda r, m: r["methods"][m]["covered"], unit="%"),
        Measure("gain", "Gain over the first view, of the oracle's", _gain_over_oracle, unit="%"),
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim(
            "Frames chosen by expected new area show more than frames chosen by rules that ignore the surface.",
            "covered",
            4,
            ("farthest", "random", EVEN),
        ),
    )
    seed: ClassVar[int] = 17
    quick: ClassVar[Mapping[str, Any]] = {"num_samples": 4, "grid_resolution": 48, "capacity": 1000}
    paper: ClassVar[Mapping[str, Any]] = {"num_samples": 16, "grid_resolution": 100, "capacity": 8192}

    folder: str = eqx.field(static=True, kw_only=True)
    box: Box = eqx.field(kw_only=True)
    voxel: float = eqx.field(static=True, kw_only=True)
    up: tuple[float, float, float] | None = eqx.field(static=True, default=None)
    intrinsics: tuple[float, float, float, float] | None = eqx.field(static=True, default=None)
    depth_scale: float | None = eqx.field(static=True, default=None)

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """Return the study of one recording, under the name "".

        By default, the side of a voxel is 1/80 of the box's longest side.

        - `options`: settings of `RecordedStudy`, except that `box` is two corners as six numbers; default: `bounds_of`.

        **Raises:** `ValueError` if the model has known shapes, or if `options` holds `num_candidates`. `TypeError` for
        an option that is no setting.
        """
        require(
            "num_candidates" not in options,
            f"--candidates {options.get('num_candidates')} cannot be used, because the candidates are the frames of "
            "the recording: leave it out",
        )
        require(model in MODELS, f"a recording has no known shapes: give one of the models {', '.join(MODELS)}")
        folder = str(Path(options.pop("folder")).resolve())
        sensor: dict[str, Any] = {name: options.pop(name, None) for name in ("up", "intrinsics", "depth_scale")}
        frames = RecordedFrames(folder, **sensor)
        corners = options.pop("box", None) or bounds_of(frames)
        box = Box(corners[:3], corners[3:])
        longest = float(np.max(box.high - box.low))
        settings: dict[str, Any] = {"voxel": longest / _VOXELS_ALONG_BOX}
        settings |= cls.quick if quick else {"num_samples": 8, "grid_resolution": 100, "capacity": 2000}
        study = cls(
            views=views,
            num_candidates=len(frames),
            sampler=SurfaceSampler.preset(model, quick=quick, volume=frame_of_box(box).to_scene(box)),
            camera=frame_of_box(box).to_scene(frames.camera.strided(stride_of(frames.camera))),
            folder=folder,
            box=box,
            **sensor,
            **settings | options,
        )
        return {"": study}

    @property
    def recording(self) -> Recording:
        """The recording, which is read once per process."""
        carving, frame = self.sampler.carving, frame_of_box(self.box)
        scan_box = self.box if carving is None else carving.with_room(self.box, self.grid, frame)
        sensor = self.up, self.intrinsics, self.depth_scale
        return read_recording((self.folder, *sensor), self.box, self.voxel, scan_box)

    @property
    def candidates(self) -> GivenPoses:
        return GivenPoses(self.recording.poses)

    def scene(self, index: int) -> Scene:
        return Scene(index, f"{Path(self.folder).name}, start {index}", _UnknownSurface())

    def sensor(self, scene: Scene) -> Sensor:
        return lambda pose, key: self.recording.scans[self.frame_of(pose)]

    def first_view(self, scene: Scene) -> int:
        """Return the index of a random frame that shows at least 5 % of the box's voxels.

        No two scenes start from the same frame until all such frames have been used.

        **Raises:** `ValueError` if there is no such frame.
        """
        frames = np.flatnonzero(self.recording.is_shown.mean(axis=1) >= _MIN_SHOWN_FRACTION)
        require(len(frames) > 0, f"no frame of {self.folder} shows 5 % of the voxels in {self.box}: give a smaller box")
        order = jax.random.permutation(jax.random.key(self.seed), len(frames))
        return int(frames[order[scene.index % len(frames)]])

    @property
    def imagined_camera(self) -> Camera:
        return self.camera.resized(*_RAYS)

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        return Coverage() if method == COVERAGE else NewSurface()

    def search(self, method: str, scene: Scene) -> Search:
        if method == EVEN:
            # Frames are evenly spaced over the recording, start at the first view, and wrap around at the end.
            offsets = np.round(np.arange(self.views) * self.num_candidates / self.views).astype(int)
            order = (self.first_view(scene) + offsets) % self.num_candidates
            return FixedOrder(self.candidates, order=jnp.asarray(order))
        if method == ORACLE:
            return MostNewVoxels(self.candidates, is_shown=jnp.asarray(self.recording.is_shown))
        return super().search(method, scene)

    def truth(self, scene: Scene) -> Bool[np.ndarray, "frames voxels"]:
        return self.recording.is_shown

    def follow(
        self, scene: Scene, truth: Bool[np.ndarray, "frames voxels"], planner: Planner, episode: Iterator[Step]
    ) -> Record:
        """Record the chosen frames, and the fraction of the voxels that they show after each view."""
        frames = [self.frame_of(step.view.pose) for step in episode]
        is_shown = np.logical_or.accumulate(truth[frames], axis=0)
        return {"frames": frames, "covered": is_shown.mean(axis=1).tolist()}

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture:
        """Return a picture of the voxels, seen along the box's shortest side, and of the camera's path."""
        recording, runs = self.recording, record["methods"]
        plane_axes = np.sort(np.argsort(self.box.high - self.box.low)[1:])
        voxels, positions = recording.voxels[:, plane_axes], recording.camera_positions[:, plane_axes]

        def tile(axes: Axes, method: str, view: int) -> None:
            frames = runs[method]["frames"][: view + 1]
            is_shown = recording.is_shown[frames].any(axis=0)
            for mask, colour in ((~is_shown, LINE), (is_shown, NEW)):
                axes.scatter(voxels[mask, 0], voxels[mask, 1], s=2.0, c=colour, linewidths=0)
            axes.plot(positions[:, 0], positions[:, 1], color=GREY, lw=0.6)
            axes.scatter(positions[frames, 0], positions[frames, 1], s=14.0, c=INK, zorder=3)
            for number, position in enumerate(positions[frames], start=1):
                axes.annotate(str(number), position, textcoords="offset points", xytext=(3, 3), fontsize=8, zorder=4)
            axes.set_aspect("equal")
            caption_tile(axes, f"{runs[method]['covered'][view]:.0%}")

        return ScenePicture("Coloured: voxels that the frames show. Numbers: their camera positions, in order.", tile)

    def frame_of(self, pose: Pose) -> int:
        """Return the index of the frame whose pose is nearest to `pose`."""
        poses = self.recording.poses
        shifts, turns = jnp.abs(poses.position - pose.position), jnp.abs(poses.rotation - pose.rotation)
        return int(jnp.argmin(shifts.sum(-1) + turns.sum((-1, -2))))
