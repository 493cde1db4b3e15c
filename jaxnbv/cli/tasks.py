"""What the tasks of the command line are: their sensor, their acquisition, and an object to show them on."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxnbv.acquisition import Acquisition, ExpectedUtilityImprovement
from jaxnbv.checks import require
from jaxnbv.cli.options import Position
from jaxnbv.geometry.camera import Camera
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
from jaxnbv.scanning.sensors import USUAL_SETTING, Setting
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
from jaxnbv.studies.sensors import HEAT_SETTING, PART_SETTING
from jaxnbv.tasks import (
    Classifier,
    ColdestPoint,
    CrossEntropy,
    EntropyReduction,
    MixedEntropy,
    NewSurface,
    SoftPartCount,
)

# Points of a cloud that the demo's classifier is fed.
_FED = 512
# Categories that none of the objects have that the shipped segmenter was trained on.
_UNKNOWN_TO_SEGMENTER = ("cap", "car", "knife")


class Given(NamedTuple):
    """What a user gives: a mesh, the camera, where its first view is taken, and options that some tasks take."""

    mesh: TriangleMesh
    camera: Camera
    first: Pose
    network: Path | None = None
    category: str | None = None
    source: Position | None = None


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


class CommandTask(NamedTuple):
    """A task of `jaxnbv run` and `jaxnbv demo`.

    - `acquisition`: on an object of the user's; options that the task requires are there.
    - `demo`: one of the objects that ship, by the numbers of a scene and of a seed.
    - `setting`: its sensor.
    """

    acquisition: Callable[[Given], Acquisition]
    demo: Callable[[int, int], Shown]
    setting: Setting = USUAL_SETTING


def _mug(scene: int, seed: int) -> Shown:
    """A mug, the only one."""
    return Shown("mug", demo_object(), NewSurface(), usual_first())


def _class_task(of: Callable[[Classifier], Acquisition]) -> CommandTask:
    """To know an object's class, by an acquisition of a classifier."""

    def acquisition(given: Given) -> Acquisition:
        assert given.network is not None
        network = load_checkpoint(given.network)
        return of(CloudClassifier(network, scale=network_scale(network)))

    def demo(scene: int, seed: int) -> Shown:
        """A truck; only what it carries tells the class, and the first view, from above the ground, does not show it.
        The grid is that of the surfaces that the classifier was trained on."""
        truck = truck_scene(Split.TEST, scene, turned=False)
        around = sphere_candidates(120)
        first = hidden_view(truck, jax.random.key(seed), poses=around[np.asarray(around.position[:, 1]) > 0])
        side = Framing.CLOSE_UP.longest_side
        shown = of(pretrained_classifier("truck", side, num_points=_FED))
        note = f"the truck carries a {HOUSEHOLD[int(truck.label)]}, which the first view does not show"
        grid = Grid(64, 0.7 * side)
        return Shown("truck", SDFSurface(truck), shown, first, "truck", grid, note, ("sure=0.95",))

    return CommandTask(acquisition, demo)


def _of_parts(given: Given) -> Acquisition:
    assert given.category is not None
    if given.network is None:
        require(
            given.category not in _UNKNOWN_TO_SEGMENTER,
            f"--category {given.category}: the segmenter that ships was not trained on it: give --network FILE",
        )
        return _counting(part_segmenter(given.category))
    network = load_checkpoint(given.network)
    return _counting(CloudSegmenter(network, given.category, scale=network_scale(network)))


def _thing_of_parts(scene: int, seed: int) -> Shown:
    thing = part_scene(Split.TEST, scene)
    category = CATEGORIES[int(thing.category)].name
    shown = _counting(part_segmenter(category))
    return Shown(category, SDFSurface(thing.solid), shown, usual_first(), bank="parts", until=("found=60",))


def _counting(segmenter: CloudSegmenter) -> Acquisition:
    return ExpectedUtilityImprovement(SoftPartCount(segmenter), segmenter.num_points)


def _heated_thing(scene: int, seed: int) -> Shown:
    heated = heat_scene(scene)
    first = source_view(heated, jax.random.key(seed))
    return Shown(heated.name, heated.surface, _heated_at(np.asarray(heated.source)), first, bank="heat")


def _heated_at(source: np.ndarray) -> Acquisition:
    return ExpectedUtilityImprovement(ColdestPoint(source), num_points=2048)


COMMAND_TASKS = {
    "cross-entropy": _class_task(CrossEntropy),
    "entropy": _class_task(EntropyReduction),
    "mixed": _class_task(MixedEntropy),
    "coverage": CommandTask(lambda given: NewSurface(), _mug),
    "parts": CommandTask(_of_parts, _thing_of_parts, PART_SETTING),
    "heat": CommandTask(lambda given: _heated_at(_source(given)), _heated_thing, HEAT_SETTING),
}


def usual_first(radius: float | None = None) -> Pose:
    """Where a first view is taken if nothing else is said: from the usual side, so far away (scene units)."""
    usual = (0.8, 0.9, 2.2)
    scale = 1.0 if radius is None else radius / math.hypot(*usual)
    return look_at(tuple(scale * x for x in usual))


def _source(given: Given) -> np.ndarray:
    """The object's point nearest to the place that was asked for, or the one in the middle of the first view."""
    if given.source is not None:
        points = given.mesh.sample_points(jax.random.key(0), 20_000)
        return points[np.linalg.norm(points - given.source, axis=1).argmin()]
    points, _ = scan(given.mesh, given.camera, given.first).to_numpy()
    require(len(points) > 0, "the first view does not see the object: give another --first, or a --source")
    away, forward = points - np.asarray(given.first.position), np.asarray(given.first.forward)
    beside = np.linalg.norm(away - (away @ forward)[:, None] * forward, axis=1)
    return points[beside.argmin()]
