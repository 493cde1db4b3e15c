"""The shipped networks. `scripts/train_classifier.py` and `scripts/train_parts.py` train them."""

from importlib import resources

from jaxnbv.checks import require
from jaxnbv.networks.checkpoints import Network, load_checkpoint
from jaxnbv.networks.clouds import CloudClassifier, CloudSegmenter
from jaxnbv.networks.invariant import InvariantClassifier

# Longest side of the box of a training object, in scene units.
TRAINED_SIDE = 2.5
# Number of points of each training cloud, for each classifier.
TRAINED_POINTS = {"pyramid": 1024, "truck": 2048, "household": 1024}


def pretrained_classifier(
    name: str, longest_side: float = TRAINED_SIDE, num_points: int | None = None
) -> CloudClassifier:
    """Load the shipped classifier for one kind of procedural scenes.

    - `name`: "pyramid", "truck" or "household".
    - `longest_side`: longest side of the object's box, in scene units.
    - `num_points`: number of input points, by default the number used in training. With half as many points the
      classifier is twice as fast and a little less accurate.

    **Raises:** `ValueError` if there is no classifier with this name, or if `longest_side` or `num_points` is not
    positive.
    """
    names = ", ".join(TRAINED_POINTS)
    require(name in TRAINED_POINTS, f"there is no shipped classifier {name!r}: choose from {names}, or load your own")
    network, count = _shipped(name), TRAINED_POINTS[name] if num_points is None else num_points
    return CloudClassifier(network, count, network_scale(network, longest_side))


def part_segmenter(category: str | int, num_points: int = 2048, longest_side: float = TRAINED_SIDE) -> CloudSegmenter:
    """Load the shipped part segmenter for a category of procedural objects.

    The segmenter was trained on partial views of upright objects with a longest side of 2.5. All objects of a category
    faced the same direction. The categories cap, car and knife were not in the training set, so results for these
    categories are not reliable.

    - `longest_side`: longest side of the object's box, in scene units.

    **Raises:** `ValueError` for an unknown category, or if `num_points` or `longest_side` is not positive.
    """
    network = _shipped("parts")
    return CloudSegmenter(network, category, num_points, network_scale(network, longest_side))


def network_scale(network: Network, longest_side: float = TRAINED_SIDE) -> float:
    """Return network units per scene unit, for objects whose box has this longest side in scene units.

    `InvariantClassifier` expects objects with a longest side of 2.5. The other networks expect objects with a longest
    side of 2, which fill the unit sphere or its bounding box.

    **Raises:** `ValueError` if `longest_side` is not positive.
    """
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    return (TRAINED_SIDE if isinstance(network, InvariantClassifier) else 2.0) / longest_side


def _shipped(name: str) -> Network:
    with resources.as_file(resources.files("jaxnbv.networks") / "weights" / f"{name}.safetensors") as path:
        return load_checkpoint(path)
