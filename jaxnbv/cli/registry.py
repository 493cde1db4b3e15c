"""What the command line must know before anything heavy is imported: tasks, models, searches, rules.

A new task, search or rule is a name here and what it stands for, in `tasks.py` or `play.py`.
"""

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple


class TaskEntry(NamedTuple):
    """What the views are for.

    - `about`: a clause for the help.
    - `options`: those of `run` that it takes, and which of them it `requires`, with a hint.
    """

    about: str
    options: tuple[str, ...] = ()
    requires: Mapping[str, str] = MappingProxyType({})


_CLASSIFIER = ("network",), {"network": "a classifier: give --network FILE"}

TASKS = {
    "cross-entropy": TaskEntry("the object's class", *_CLASSIFIER),
    "entropy": TaskEntry("its class, by the entropy that a view removes", *_CLASSIFIER),
    "mixed": TaskEntry("its class, by one and then the other", *_CLASSIFIER),
    "coverage": TaskEntry("its shape"),
    "parts": TaskEntry("its parts", ("network", "category"), {"category": "--category, such as chair or mug"}),
    "heat": TaskEntry("its coldest point when it is heated", ("source",)),
}

MODELS = {
    "screened": "knows what was seen to be empty too",
    "paper": "knows the scanned normals alone",
}

STUDY_MODELS = {"known": "screened, and has seen other objects of the kind", **MODELS}

BANKS = ("pyramid", "truck", "household", "parts", "heat", "household-real")
"""The banks of known shapes that ship."""

SEARCHES = {
    "discrete": "the best of all candidates",
    "halving": "the same, sooner: drops the worse half again and again",
    "tie-break": "coverage decides where candidates are level",
    "gradient-2dof": "climbs over the sphere",
    "gradient-constrained": "climbs over positions and rotations",
    "hybrid": "climbs from the best candidates",
    "farthest": "a baseline, far from all views",
    "random": "a baseline",
    "uncertainty": "a baseline, where the surface is least known",
}

STOPS = {
    "sure": "probability of the class",
    "found": "points of every part",
    "covered": "share seen of what can be seen",
    "value-below": "value of the best view",
    "seconds": "passed",
    "travel": "length of the way",
}


def resolve(text: str) -> Any:
    """What a registry names, module:name, imported."""
    module, _, name = text.partition(":")
    return getattr(importlib.import_module(module), name)
