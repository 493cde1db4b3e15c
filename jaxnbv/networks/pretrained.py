"""The networks that ship with jaxnbv; `scripts/train_classifier.py` and `scripts/train_parts.py` make their weights."""

from importlib import resources

from jaxnbv.checks import require
from jaxnbv.networks.checkpoints import Network, load_checkpoint
from jaxnbv.networks.clouds import CloudClassifier, CloudSegmenter
from jaxnbv.networks.invariant import InvariantClassifier

# Longest side of the box of a training object, in scene units.
TRAINED_SIDE = 2.5
# Points of a cloud that each classifier was trained on.
TRAINED_POINTS = {"pyramid": 1024, "truck": 2048, "household": 1024}


def pretrained_classifier(
    name: str, longest_side: float = TRAINED_SIDE, num_points: int | None = None
) -> CloudClassifier:
    """The shipped classifier of the procedural scenes of a name, whose boxes have this longest side, in scene units.

    - `name`: "pyramid", "truck" or "household".
    - `num_points`: what it is fed, by default as many as it was trained on; with half as many it is a little less often
      right, and twice as fast.

    **Raises:** `ValueError` for another name, or if `longest_side` or `num_points` is not positive.
    """
    known = ", ".join(TRAINED_POINTS)
    require(name in TRAINED_POINTS, f"no classifier of {name!r} ships: give the file of one, or choose from {known}")
    network = _shipped(name)
    fed = TRAINED_POINTS[name] if num_points is None else num_points
    return CloudClassifier(network, fed, network_scale(network, longest_side))


def part_segmenter(category: str | int, num_points: int = 2048, longest_side: float = TRAINED_SIDE) -> CloudSegmenter:
    """The shipped segmenter of procedural objects, for one of their categories.

    It was trained on objects whose box has the longest side 2.5, upright and facing one way, seen by parts; on none of
    the categories cap, car and knife, of which it says nothing that can be relied on.

    **Raises:** `ValueError` for an unknown category, or if `num_points` or `longest_side` is not positive.
    """
    network = _shipped("parts")
    return CloudSegmenter(network, category, num_points, network_scale(network, longest_side))


def network_scale(network: Network, longest_side: float = TRAINED_SIDE) -> float:
    """Network units per scene unit, for an object whose box has this longest side in the scene.

    `InvariantClassifier` takes objects 2.5 long, the others those that fill the unit sphere or its box.

    **Raises:** `ValueError` if `longest_side` is not positive.
    """
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    return (TRAINED_SIDE if isinstance(network, InvariantClassifier) else 2.0) / longest_side


def _shipped(name: str) -> Network:
    with resources.as_file(resources.files("jaxnbv.networks") / "weights" / f"{name}.safetensors") as path:
        return load_checkpoint(path)
