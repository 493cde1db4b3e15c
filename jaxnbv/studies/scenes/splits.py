"""Splits of procedural scenes (training, validation and test), and the random keys of scenes."""

from enum import StrEnum

import jax
from jaxtyping import Array, Int, PRNGKeyArray

from jaxnbv.checks import require


class Split(StrEnum):
    """Disjoint sets of scenes for training, for tuning (validation) and for reported results (test)."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


def scene_key(seed: int, split: Split, index: int | Int[Array, ""]) -> PRNGKeyArray:
    """Return the random key of the scene with this index in a split. Each kind of scene has its `seed`.

    **Raises:** `ValueError` if the index is negative.
    """
    require(isinstance(index, jax.Array) or index >= 0, f"the scene's number is {index}; it must not be negative")
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), list(Split).index(split)), index)
