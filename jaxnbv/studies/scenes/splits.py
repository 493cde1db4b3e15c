"""Which scenes, how large an object stands, and from where it is seen first."""

from enum import StrEnum

import jax
from jaxtyping import Array, Int, PRNGKeyArray

from jaxnbv.checks import require


class Split(StrEnum):
    """Which scenes are trained on, tuned on and reported: no two splits share one."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


class Framing(StrEnum):
    """How large the object stands before the sensor: a view shows a patch, or nearly all of its near side."""

    CLOSE_UP = "close-up"
    WHOLE = "whole"

    @property
    def longest_side(self) -> float:
        """Longest side of the object's box in scene units."""
        return 2.5 if self is Framing.CLOSE_UP else 1.25


class FirstView(StrEnum):
    """Which views of an object may be the first one: any, or those after which the classifier is wrong."""

    ANY = "any"
    MISCLASSIFIED = "misclassified"


def scene_key(seed: int, split: Split, index: int | Int[Array, ""]) -> PRNGKeyArray:
    """What scene number `index` of a split is made of, for scenes of one kind, told by `seed`.

    **Raises:** `ValueError` if the index is negative.
    """
    require(isinstance(index, jax.Array) or index >= 0, f"the scene's number is {index}; it must not be negative")
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), list(Split).index(split)), index)
