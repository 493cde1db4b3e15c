"""What the tasks of the command line are: their sensor, their acquisition, and an object to show them on."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxnbv.acquisition import Acquisition, ExpectedUtilityImprovement
from jaxnbv.checks import InputError, require
from jaxnbv.cli.registry import DEFAULT_FIRST
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.networks import (
    CATEGORIES,
    CloudClassifier,
    CloudSegmenter,
    load_checkpoint,
    network_scale,
    part_segmenter,
    pretrained_classifier,
)
from jaxnbv.scanning import Grid, SDFSurface, Surface, TriangleMesh, scan
from jaxnbv.scanning.sensors import HEAT_SETTING, PART_SETTING, USUAL_SETTING, Setting
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.studies.scenes import (
    HOUSEHOLD,
    Framing,
    Split,
    demo_object,
    heat_scene,
    hidden_view,
    part_scene,
    source_view,
    truck_scene,
)
from jaxnbv.tasks import (
    Classifier,
    ColdestPoint,
    CrossEntropy,
    MixedEntropy,
    NegativeEntropy,
    NewSurface,
    SoftPartCount,
)
from jaxnbv.tasks.diffusion import HeatProblem

# Points of a cloud that the demo's classifier is fed.
_FED = 512


class Known(ABC):
    """What is known of a user's object before a view of it is chosen, in scene coordinates.

    - `first`: where the first view is taken.
    """

    first: Pose

    @abstractmethod
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Points of it."""

    @abstractmethod
    def first_points(self) -> Float[np.ndarray, "n 3"]:
        """Those that the first view shows."""


@dataclass(frozen=True)
class OfMesh(Known):
    """Of a mesh all is known. `camera`: which takes the first view."""

    surface: TriangleMesh
    first: Pose
    camera: Camera

    def points(self) -> Float[np.ndarray, "n 3"]:
        return self.surface.sample_points(jax.random.key(0), 20_000)

    def first_points(self) -> Float[np.ndarray, "n 3"]:
        return scan(self.surface, self.camera, self.first).to_numpy()[0]


@dataclass(frozen=True)
class OfScan(Known):
    """Of what a sensor saw its first scan."""

    first: Pose
    seen: PointCloud

    def points(self) -> Float[np.ndarray, "n 3"]:
        return self.seen.to_numpy()[0]

    def first_points(self) -> Float[np.ndarray, "n 3"]:
        return self.points()


class Given(NamedTuple):
    """What a user gives: an object, and options that some tasks take."""

    known: Known
    network: Path | None = None
    category: str | None = None
    source: str | None = None


class Shown(NamedTuple):
    """An object to show a task on.

    - `bank`: the shapes that are known, as of `--known`; `grid`: of the imagined surfaces.
    - `note`: what is said of the object before; `until`: what is enough, as of `--until`.
    """

    name: str
    surface: Surface
    acquisition: Acquisition
    first: Pose
    bank: str = "none"
    grid: Grid = Grid()
    note: str = ""
    until: tuple[str, ...] = ()


class CommandTask(ABC):
    """A task of `jaxnbv run` and `jaxnbv demo`. `setting` is its sensor."""

    setting: Setting = USUAL_SETTING

    @abstractmethod
    def acquisition(self, given: Given) -> Acquisition:
        """The acquisition on a mesh of the user's; options that the task requires are there."""

    @abstractmethod
    def demo(self, scene: int, seed: int) -> Shown:
        """One of the objects that ship."""


class CoverageTask(CommandTask):
    """To see all of an object."""

    def acquisition(self, given: Given) -> Acquisition:
        return NewSurface()

    def demo(self, scene: int, seed: int) -> Shown:
        """A laid tea mug, the only one."""
        return Shown("mug", demo_object(), NewSurface(), usual_first())


class ClassTask(CommandTask):
    """To know an object's class, by an acquisition of a classifier."""

    def __init__(self, of: Callable[[Classifier], Acquisition]):
        self.of = of

    def acquisition(self, given: Given) -> Acquisition:
        assert given.network is not None
        network = load_checkpoint(given.network)
        return self.of(CloudClassifier(network, scale=network_scale(network)))

    def demo(self, scene: int, seed: int) -> Shown:
        """A truck; only what it carries tells the class, and the first view, from above the ground, does not show it.
        The grid is that of the surfaces that the classifier was trained on."""
        truck = truck_scene(Split.TEST, scene, turned=False)
        around = sphere_candidates(120)
        first = hidden_view(truck, jax.random.key(seed), poses=around[np.asarray(around.position[:, 1]) > 0])
        side = Framing.CLOSE_UP.longest_side
        acquisition = self.of(pretrained_classifier("truck", side, num_points=_FED))
        note = f"the truck carries a {HOUSEHOLD[int(truck.label)]}, which the first view does not show"
        grid = Grid(64, 0.7 * side)
        return Shown("truck", SDFSurface(truck), acquisition, first, "truck", grid, note, ("sure=0.95",))


class PartTask(CommandTask):
    """To find all parts of an object of a category."""

    setting = PART_SETTING

    def acquisition(self, given: Given) -> Acquisition:
        assert given.category is not None
        if given.network is None:
            return self._of(part_segmenter(given.category))
        network = load_checkpoint(given.network)
        return self._of(CloudSegmenter(network, given.category, scale=network_scale(network)))

    def demo(self, scene: int, seed: int) -> Shown:
        """A procedural object."""
        thing = part_scene(Split.TEST, scene)
        category = CATEGORIES[int(thing.category)].name
        acquisition = self._of(part_segmenter(category))
        return Shown(category, SDFSurface(thing.solid), acquisition, usual_first(), bank="parts", until=("found=60",))

    def _of(self, segmenter: CloudSegmenter) -> Acquisition:
        return ExpectedUtilityImprovement(SoftPartCount(segmenter), segmenter.num_points)


class HeatTask(CommandTask):
    """To find the coldest point of a body that is heated at one place."""

    setting = HEAT_SETTING

    def acquisition(self, given: Given) -> Acquisition:
        """Heated at the point that was asked for, or at the one in the middle of the first view."""
        return self._of(_middle(given.known) if given.source is None else _asked(given.known, given.source))

    def demo(self, scene: int, seed: int) -> Shown:
        """A procedural object."""
        heated = heat_scene(scene)
        first = source_view(heated, jax.random.key(seed))
        return Shown(heated.name, heated.surface, self._of(np.asarray(heated.source)), first, bank="heat")

    def _of(self, source: np.ndarray) -> Acquisition:
        return ExpectedUtilityImprovement(ColdestPoint(source), num_points=2048)


COMMAND_TASKS: dict[str, CommandTask] = {
    "cross-entropy": ClassTask(CrossEntropy),
    "entropy": ClassTask(lambda classifier: ExpectedUtilityImprovement(NegativeEntropy(classifier), num_points=1024)),
    "mixed": ClassTask(MixedEntropy),
    "coverage": CoverageTask(),
    "parts": PartTask(),
    "heat": HeatTask(),
}


def usual_first() -> Pose:
    """Where a first view is taken if nothing else is said."""
    return look_at(position("--first", DEFAULT_FIRST))


def position(option: str, text: str) -> tuple[float, float, float]:
    """Three numbers of an option.

    **Raises:** `ValueError` unless these are three finite numbers.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} is {text!r}; give three numbers such as {DEFAULT_FIRST}") from error
    require(bool(np.isfinite([x, y, z]).all()), f"{option} is {text!r}; its numbers must be finite")
    return x, y, z


def _asked(known: Known, source: str) -> np.ndarray:
    place, points = np.asarray(position("--source", source)), known.points()
    nearest = points[np.linalg.norm(points - place, axis=1).argmin()]
    distance = float(np.linalg.norm(nearest - place))
    require(
        distance <= HeatProblem.radius,
        f"--source is {source}, {distance:.2f} away from the object, but heat goes in within {HeatProblem.radius} "
        f"only. The nearest point is {','.join(f'{x:.2f}' for x in nearest)}",
    )
    return place


def _middle(known: Known) -> np.ndarray:
    points = known.first_points()
    require(len(points) > 0, "the first view does not see the object: give another --first, or a --source")
    away, forward = points - np.asarray(known.first.position), np.asarray(known.first.forward)
    along = away @ forward
    beside = np.linalg.norm(away - along[:, None] * forward, axis=1)
    return points[beside.argmin()]
