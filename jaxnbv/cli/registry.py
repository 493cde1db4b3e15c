"""Names of models, searches and stop rules on the command line. This module does not import JAX."""

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

# `jaxnbv` is lazy: it imports a module only when a name from that module is used.
import jaxnbv as nbv

if TYPE_CHECKING:
    from jaxnbv.planning.stopping import StopRule


MODELS = {
    "screened": "uses scanned points and normals, and space that was seen to be empty",
    "paper": "uses only the scanned normals",
}

STUDY_MODELS = {"known": "screened, with a bank of similar objects as known shapes", **MODELS}

STUDY_SETTINGS = {
    "usual": "the study's own settings, smaller than the paper's",
    "paper": "the paper's settings and model, with which a study takes hours",
}

BANKS = ("pyramid", "truck", "household", "parts", "heat", "household-real")
"""The shipped banks of known shapes."""

SEARCHES = {
    "discrete": "the best of all candidates",
    "halving": "like discrete, but faster, because it repeatedly drops the worse half of the candidates",
    "tie-break": "like discrete, but coverage decides between tied candidates",
    "gradient-2dof": "gradient ascent on the sphere",
    "gradient-constrained": "gradient ascent over positions and rotations",
    "hybrid": "gradient ascent from the best candidates",
    "farthest": "a baseline, the candidate farthest from all views",
    "random": "a baseline, a random candidate",
    "uncertainty": "a baseline, where the surface is least certain",
}


class Stop(NamedTuple):
    """A rule of `--until`: what its number means, and a function that makes the rule from the number."""

    about: str
    rule: "Callable[[float], StopRule]"


STOPS = {
    "sure": Stop("probability of the class", lambda probability: nbv.Sure(probability)),
    "parts-found": Stop("number of points of every part", lambda points: nbv.PartsFound(int(points))),
    "covered": Stop("fraction of the visible surface that was seen", lambda share: nbv.Covered(share)),
    "identified": Stop("probability of the part", lambda probability: nbv.Identified(probability)),
    "placed": Stop("root mean square error of the part's surface", lambda length: nbv.Placed(length)),
    "value-below": Stop("value of the best view", lambda value: nbv.ValueBelow(value)),
    "seconds": Stop("elapsed time", lambda seconds: nbv.Budget(seconds=seconds)),
    "travel": Stop("length of the camera's path", lambda length: nbv.Budget(cost=length)),
}


def resolve(text: str) -> Any:
    """Import and return an object, given as "module:name"."""
    module, _, name = text.partition(":")
    return getattr(importlib.import_module(module), name)
