"""What the command line must know before anything heavy is imported: tasks, models, searches, rules, devices.

A new task, search or rule is a name here and what it stands for: in `actions/tasks.py`, `actions/searches.py` or
`actions/until.py`.
"""

import importlib
from enum import StrEnum
from typing import Any, NamedTuple

DEFAULT_FIRST = "0.8,0.9,2.2"


class Device(StrEnum):
    """Where the computation runs."""

    AUTO = "auto"
    CPU = "cpu"
    GPU = "gpu"


class TaskEntry(NamedTuple):
    """What the views are for.

    - `about`: a clause for the help.
    - `options`: those of `run` that it takes, and which of them it `requires`, with a hint.
    """

    about: str
    options: tuple[str, ...] = ()
    requires: tuple[tuple[str, str], ...] = ()


_CLASSIFIER = ("network",), (("network", "a classifier: give --network FILE"),)

TASKS = {
    "cross-entropy": TaskEntry("the object's class, by expected cross-entropy", *_CLASSIFIER),
    "entropy": TaskEntry("the class, by expected reduction of entropy", *_CLASSIFIER),
    "mixed": TaskEntry(
        "the class, by cross-entropy until the entropy falls to 0.75, then by its reduction", *_CLASSIFIER
    ),
    "coverage": TaskEntry("its shape"),
    "parts": TaskEntry("its parts", ("network", "category"), (("category", "--category, such as chair or mug"),)),
    "heat": TaskEntry("the coldest point while it is heated at one place", ("source",)),
}

MODELS = {
    "screened": "knows that the object lies in its box and that space which was seen through is empty",
    "paper": "the published model, which knows the scanned normals alone",
}

STUDY_MODELS = {"known": "screened, and has seen other objects of the kind", **MODELS}

BANKS = ("pyramid", "truck", "household", "fruit", "parts", "heat", "household-real")
"""The banks of known shapes that ship."""

SEARCHES = {
    "discrete": "the expected value of the task over 120 candidates (heat: 100)",
    "halving": "drops the worse half again and again while samples are added",
    "tie-break": "coverage, among the candidates that samples cannot tell from the best",
    "gradient-2dof": "climbs it by gradient over the sphere",
    "gradient-6dof": "over positions and rotations (up to 0.3 nearer or farther, the object's centre in view)",
    "hybrid": "over the sphere from the best candidates",
    "farthest": "the paper's baseline, farthest from the views so far",
    "random": "a baseline",
    "uncertainty": "a baseline, where the surface is most uncertain",
}

STOPS = {
    "sure": "the class has this probability, and given every half of the points too",
    "found": "every part has so many points",
    "covered": "this share of what can be seen is expected to have been seen",
    "value-below": "the best view has a value less than this",
    "seconds": "so many have passed",
    "travel": "the way from view to view would be longer, in scene units",
}


def resolve(text: str) -> Any:
    """What a registry names, module:name, imported."""
    module, _, name = text.partition(":")
    return getattr(importlib.import_module(module), name)
