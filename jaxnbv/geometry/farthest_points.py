"""Farthest point sampling of the rows of a point set, in any number of dimensions (Eldar et al. 1997)."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import require


@functools.partial(jax.jit, static_argnames="count")
def farthest_point_indices(points: Float[Array, "n d"], mask: Bool[Array, " n"], count: int) -> Int[Array, " count"]:
    """`count` rows, each as far as can be from those before it, in order of choice; of equals, the first.

    Starts at the first filled row. No row is chosen twice while another that is filled is left, duplicates included;
    a cloud of fewer points than `count` gives each of them, then its first filled row again and again. The indices
    carry no derivative; points get theirs through `points[indices]`.

    **Raises:** `ValueError` if `count` < 1.
    """
    require(count >= 1, f"cannot choose {count} points; ask for at least one")
    padding = -len(points) % _FOLDS
    columns = list(jnp.pad(jax.lax.stop_gradient(jnp.where(mask[:, None], points, 0.0)), ((0, padding), (0, 0))).T)
    filled = jnp.pad(mask, (0, padding))
    rows = jnp.arange(len(filled), dtype=jnp.int32)

    def choose(carry, _):
        distance, latest = carry
        squares = [(column - column[latest]) ** 2 for column in columns]
        nearer = jnp.minimum(distance, functools.reduce(jnp.add, squares))
        distance = jnp.where(rows == latest, _CHOSEN, nearer)
        return (distance, _first_of_largest(distance, rows)), latest

    start = jnp.where(filled, jnp.inf, jnp.full_like(columns[0], _EMPTY)), jnp.argmax(mask).astype(jnp.int32)
    return jax.lax.scan(choose, start, length=count)[1]


# In place of a distance. The bits of -2.0, as an integer, are greater than those of -1.0, and less than any distance's.
_CHOSEN, _EMPTY = -2.0, -1.0
# Elementwise operations between so many parts of an array run several times as fast on a CPU as its reduction.
_FOLDS = 8


def _first_of_largest(distance: Float[Array, " n"], rows: Int[Array, " n"]) -> Int[Array, ""]:
    """argmax in the order of the numbers' bits.

    That is the order of floats that are not negative; and a maximum of integers, then a minimum of rows, runs several
    times as fast on a CPU as `jnp.argmax`.
    """
    bits = jax.lax.bitcast_convert_type(distance, jnp.dtype(f"int{8 * distance.dtype.itemsize}"))
    largest = jnp.max(_folded(jnp.maximum, bits))
    return jnp.min(_folded(jnp.minimum, jnp.where(bits == largest, rows, len(rows))))


def _folded(operation: Callable[[Array, Array], Array], values: Array) -> Array:
    return functools.reduce(operation, jnp.split(values, _FOLDS))
