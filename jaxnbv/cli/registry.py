"""Tasks, models, searches and stopping rules of the command line: what it must know before anything heavy is imported.

A new task is a class like those of `actions/tasks.py` and an entry here; a new search or rule is a function and an
entry.
"""

import importlib
from typing import Any, NamedTuple


class TaskEntry(NamedTuple):
    """What the views are for.

    - `task`: module and name of its `CommandTask`.
    - `about`: a clause for the help.
    - `options`: those of `run` that it takes, and which of them it `requires`, with a hint.
    """

    task: str
    about: str
    options: tuple[str, ...] = ()
    requires: tuple[tuple[str, str], ...] = ()


class SearchEntry(NamedTuple):
    """How the next view is found: module and name of a function of radius and number of candidates, and a clause."""

    search: str
    about: str


class StopEntry(NamedTuple):
    """When views are enough: module and name of a function of one number, and a clause with N for it."""

    stop: str
    about: str


_TASKS, _SEARCHES = "jaxnbv.cli.actions.tasks", "jaxnbv.cli.actions.searches"
_CLASSIFIER = ("network",), (("network", "a classifier: give --network FILE"),)

TASKS = {
    "cross-entropy": TaskEntry(
        f"{_TASKS}:CROSS_ENTROPY",
        "the object's class, by expected cross-entropy",
        *_CLASSIFIER,
    ),
    "entropy": TaskEntry(
        f"{_TASKS}:ENTROPY",
        "the class, by expected reduction of entropy",
        *_CLASSIFIER,
    ),
    "mixed": TaskEntry(
        f"{_TASKS}:MIXED",
        "the class, by cross-entropy until the entropy falls to 0.75, then by its reduction",
        *_CLASSIFIER,
    ),
    "coverage": TaskEntry(f"{_TASKS}:COVERAGE", "its shape"),
    "parts": TaskEntry(
        f"{_TASKS}:PARTS", "its parts", ("network", "category"), (("category", "--category, such as chair or mug"),)
    ),
    "heat": TaskEntry(f"{_TASKS}:HEAT", "the coldest point while it is heated at one place", ("source",)),
}

MODELS = {
    "screened": "knows that the object lies in its box and that space which was seen through is empty",
    "paper": "the published model, which knows the scanned normals alone",
}

STUDY_MODELS = {"known": "screened, and has seen other objects of the kind", **MODELS}

BANKS = ("pyramid", "truck", "household", "fruit", "parts", "heat", "household-real")
"""The banks of known shapes that ship."""

SEARCHES = {
    "discrete": SearchEntry(f"{_SEARCHES}:discrete", "the expected value of the task over 120 candidates (heat: 100)"),
    "halving": SearchEntry(f"{_SEARCHES}:halving", "drops the worse half again and again while samples are added"),
    "tie-break": SearchEntry(
        f"{_SEARCHES}:tie_break", "coverage, among the candidates that samples cannot tell from the best"
    ),
    "gradient-2dof": SearchEntry(f"{_SEARCHES}:gradient_2dof", "climbs it by gradient over the sphere"),
    "gradient-6dof": SearchEntry(
        f"{_SEARCHES}:gradient_6dof",
        "over positions and rotations (up to 0.3 nearer or farther, the object's centre in view)",
    ),
    "hybrid": SearchEntry(f"{_SEARCHES}:hybrid", "over the sphere from the best candidates"),
    "farthest": SearchEntry(f"{_SEARCHES}:farthest", "the paper's baseline, farthest from the views so far"),
    "random": SearchEntry(f"{_SEARCHES}:random", "a baseline"),
    "uncertainty": SearchEntry(f"{_SEARCHES}:uncertainty", "a baseline, where the surface is most uncertain"),
}


_STOPS = "jaxnbv.cli.actions.stops"

STOPS = {
    "sure": StopEntry(f"{_STOPS}:sure", "the class has this probability, and given every half of the points too"),
    "found": StopEntry(f"{_STOPS}:found", "every part has so many points"),
    "covered": StopEntry(f"{_STOPS}:covered", "this share of what can be seen is expected to have been seen"),
    "value-below": StopEntry(f"{_STOPS}:value_below", "the best view has a value less than this"),
    "seconds": StopEntry(f"{_STOPS}:seconds", "so many have passed"),
    "travel": StopEntry(f"{_STOPS}:travel", "the way from view to view would be longer, in scene units"),
}


def resolve(text: str) -> Any:
    """What a registry names, module:name, imported."""
    module, _, name = text.partition(":")
    return getattr(importlib.import_module(module), name)
