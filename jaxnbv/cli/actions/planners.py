"""What a task and a search on the command line stand for: scores, searches and planners."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnbv.acquisition import ExpectedUtilityImprovement, Score
from jaxnbv.camera import Camera
from jaxnbv.checks import require
from jaxnbv.cli.options import SearchName, Task
from jaxnbv.datasets import Framing
from jaxnbv.model_name import ModelName
from jaxnbv.networks import CloudClassifier, CloudSegmenter, load_checkpoint, load_part_segmenter, part_segmenter
from jaxnbv.planner import Planner
from jaxnbv.presets import imagination
from jaxnbv.scanning import Grid
from jaxnbv.search import (
    ConstrainedPoses,
    DiscreteSearch,
    FarthestView,
    GradientSearch,
    HalvingSearch,
    HybridSearch,
    PoseSpace,
    RandomView,
    Search,
    SphereCandidates,
    SpherePoses,
    UncertaintyView,
)
from jaxnbv.sensors import HEAT_SETTING, PART_SETTING, USUAL_SETTING, Setting
from jaxnbv.tasks import Classifier, ColdestPoint, Coverage, CrossEntropy, MixedEntropy, NegativeEntropy, SoftPartCount

CLASS_TASKS = (Task.CROSS_ENTROPY, Task.ENTROPY, Task.MIXED)
# Networks saw objects scaled into the unit sphere or its box; in the scene half the longest side is 1.25.
_NETWORK_SCALE = 1 / 1.25


def setting_of(task: Task) -> Setting:
    """The sensor of a task."""
    return {Task.PARTS: PART_SETTING, Task.HEAT: HEAT_SETTING}.get(task, USUAL_SETTING)


def class_score(task: Task, classifier: Classifier) -> Score:
    """The score of a task that is about the object's class."""
    if task is Task.ENTROPY:
        return ExpectedUtilityImprovement(NegativeEntropy(classifier), num_points=1024)
    return CrossEntropy(classifier) if task is Task.CROSS_ENTROPY else MixedEntropy(classifier)


def part_score(category: str, network: Path | None = None) -> Score:
    """The soft count of the parts of an object of a category, by the shipped segmenter or by one in a file."""
    if network is None:
        segmenter = part_segmenter(category)
    else:
        segmenter = CloudSegmenter(load_part_segmenter(network), category, scale=_NETWORK_SCALE)
    return ExpectedUtilityImprovement(SoftPartCount(segmenter), segmenter.num_points)


def heat_score(source: Float[np.ndarray, "3"]) -> Score:
    """The coldest point of a body that is heated at `source`."""
    return ExpectedUtilityImprovement(ColdestPoint(source), num_points=2048)


def mesh_score(task: Task, network: Path | None, category: str | None, source: Float[np.ndarray, "3"] | None) -> Score:
    """The score of a task on a mesh of the user's.

    **Raises:** `ValueError` for a task without what it needs, or with what it has no use for.
    """
    for name, value, tasks in (
        ("--network", network, (*CLASS_TASKS, Task.PARTS)),
        ("--category", category, (Task.PARTS,)),
    ):
        wanted = ", ".join(tasks)
        require(value is None or task in tasks, f"--task {task} takes no {name}: it is for {wanted}")
    require(task not in CLASS_TASKS or network is not None, f"--task {task} needs a classifier: give --network FILE")
    require(task is not Task.PARTS or category is not None, "--task parts needs --category, such as chair or mug")
    if task is Task.PARTS and category is not None:
        return part_score(category, network)
    if task is Task.HEAT and source is not None:
        return heat_score(source)
    if network is not None:
        return class_score(task, CloudClassifier(load_checkpoint(network), scale=_NETWORK_SCALE))
    return Coverage()


def search_of(name: SearchName, radius: float, num_candidates: int | None) -> Search:
    """A search by its name, about cameras at a distance; `num_candidates` None leaves its own number."""
    count: dict[str, Any] = {} if num_candidates is None else {"num_candidates": num_candidates}
    if name in (SearchName.GRADIENT_2DOF, SearchName.GRADIENT_6DOF, SearchName.HYBRID):
        space: PoseSpace = SpherePoses(radius)
        if name is SearchName.GRADIENT_6DOF:
            space = ConstrainedPoses(nearest=radius - 0.3, farthest=radius + 0.3)
        search = HybridSearch if name is SearchName.HYBRID else GradientSearch
        return search(space=space, **count)
    over_candidates: dict[SearchName, Any] = {
        SearchName.DISCRETE: DiscreteSearch,
        SearchName.HALVING: HalvingSearch,
        SearchName.FARTHEST: FarthestView,
        SearchName.RANDOM: RandomView,
        SearchName.UNCERTAINTY: UncertaintyView,
    }
    everywhere = SphereCandidates(radius=radius)
    return over_candidates[name](everywhere if num_candidates is None else SphereCandidates(num_candidates, radius))


def task_planner(
    task: Task, score: Score, search: SearchName, model: ModelName, quick: bool, longest_side: float = 2.5
) -> Planner:
    """The planner of a task at the authors' settings, or at small ones, for an object of this longest side."""
    camera, radius, candidates = setting_of(task)
    surfaces, carving = imagination(model, longest_side, quick)
    if not quick:
        count = None if search in (SearchName.GRADIENT_2DOF, SearchName.GRADIENT_6DOF) else candidates
        return Planner(surfaces, camera, score, search_of(search, radius, count), carving=carving)
    small = Camera(height=24, width=24)
    return Planner(surfaces, small, score, search_of(search, radius, 40), 4, Grid(56), capacity=1024, carving=carving)


def pyramid_planner(score: Score, search: SearchName, model: ModelName, framing: Framing) -> Planner:
    """The grid is that of the surfaces that the classifier was trained on; so are the surfaces, but for the paper's."""
    surfaces, carving = imagination(model, framing.longest_side)
    grid = Grid(64, 0.7 * framing.longest_side)
    return Planner(surfaces, Camera(), score, search_of(search, USUAL_SETTING.radius, None), grid=grid, carving=carving)
