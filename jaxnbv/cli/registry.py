"""What the command line must know before anything heavy is imported: tasks, models, searches, rules.

A new task, search or rule is a name here and what it stands for, in `tasks.py` or `play.py`.
"""

import importlib
from typing import Any, NamedTuple


class TaskEntry(NamedTuple):
    """What the views are for.

    - `about`: a clause for the help.
    - `requires`: options of `run` without which it does not go; `options`: others that it takes.
    """

    about: str
    requires: tuple[str, ...] = ()
    options: tuple[str, ...] = ()


TASKS = {
    "cross-entropy": TaskEntry("the object's class", ("network",)),
    "entropy": TaskEntry("its class, by the entropy that a view removes", ("network",)),
    "mixed": TaskEntry("its class, by one and then the other", ("network",)),
    "coverage": TaskEntry("its shape"),
    "parts": TaskEntry("its parts", ("category",), ("network",)),
    "heat": TaskEntry("its coldest point when it is heated", options=("source",)),
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
