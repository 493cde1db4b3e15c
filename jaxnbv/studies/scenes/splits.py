"""Which scenes there are."""

from enum import StrEnum

import jax
from jaxtyping import Array, Int, PRNGKeyArray

from jaxnbv.checks import require


class Split(StrEnum):
    """Which scenes are trained on, tuned on and reported: no two splits share one."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


def scene_key(seed: int, split: Split, index: int | Int[Array, ""]) -> PRNGKeyArray:
    """What scene number `index` of a split is made of, for scenes of one kind, told by `seed`.

    **Raises:** `ValueError` if the index is negative.
    """
    require(isinstance(index, jax.Array) or index >= 0, f"the scene's number is {index}; it must not be negative")
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), list(Split).index(split)), index)
