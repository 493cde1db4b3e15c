"""Checks at the boundary: values are checked where they are known, and errors name the value and the remedy."""

import jax
import numpy as np
from jax import Array

from jaxnbv.errors import InputError as InputError

AnyArray = Array | np.ndarray


def require(condition: bool | np.bool_, message: str) -> None:
    """Raise `InputError(message)` unless the condition holds."""
    if not condition:
        raise InputError(message)


def is_traced(*trees) -> bool:
    """Whether any leaf is a tracer, that is, has no value yet because a JAX transformation is under way."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))
