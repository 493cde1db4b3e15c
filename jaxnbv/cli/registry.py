"""The names of models, searches and rules on the command line, known before anything heavy is imported."""

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

# Its names load what they stand for once they are used.
import jaxnbv as nbv

if TYPE_CHECKING:
    from jaxnbv.planning.stopping import StopRule


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


class Stop(NamedTuple):
    """A rule of `--until`: what its number is, and the rule of a number."""

    about: str
    rule: "Callable[[float], StopRule]"


STOPS = {
    "sure": Stop("probability of the class", lambda probability: nbv.Sure(probability)),
    "found": Stop("points of every part", lambda points: nbv.Found(int(points))),
    "covered": Stop("share seen of what can be seen", lambda share: nbv.Covered(share)),
    "identified": Stop("probability of the part", lambda probability: nbv.Identified(probability)),
    "placed": Stop("how far its surface may be off", lambda length: nbv.Placed(length)),
    "value-below": Stop("value of the best view", lambda value: nbv.ValueBelow(value)),
    "seconds": Stop("passed", lambda seconds: nbv.Budget(seconds=seconds)),
    "travel": Stop("length of the way", lambda length: nbv.Budget(cost=length)),
}


def resolve(text: str) -> Any:
    """What a registry names, module:name, imported."""
    module, _, name = text.partition(":")
    return getattr(importlib.import_module(module), name)
