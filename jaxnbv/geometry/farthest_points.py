"""Farthest point sampling in any number of dimensions (Eldar et al. 1997)."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import require


@functools.partial(jax.jit, static_argnames="count")
def farthest_point_indices(points: Float[Array, "n d"], mask: Bool[Array, " n"], count: int) -> Int[Array, " count"]:
    """Return the indices of `count` filled rows, each as far as possible from all rows chosen before it.

    Rows are filled where `mask` is True. The first choice is the first filled row, and ties go to the first row. Every
    filled row is chosen once, even if points coincide, before the first filled row is repeated.

    **Raises:** `ValueError` if `count` < 1.
    """
    require(count >= 1, f"cannot choose {count} points; ask for at least one")
    padding = -len(points) % _NUM_PARTS
    columns = list(jnp.pad(jax.lax.stop_gradient(jnp.where(mask[:, None], points, 0.0)), ((0, padding), (0, 0))).T)
    filled = jnp.pad(mask, (0, padding))
    rows = jnp.arange(len(filled), dtype=jnp.int32)

    def choose(carry, _):
        distance, latest = carry
        squares = [(column - column[latest]) ** 2 for column in columns]
        nearest = jnp.minimum(distance, functools.reduce(jnp.add, squares))
        distance = jnp.where(rows == latest, _CHOSEN_DISTANCE, nearest)
        return (distance, _first_of_largest(distance, rows)), latest

    start = jnp.where(filled, jnp.inf, jnp.full_like(columns[0], _EMPTY_DISTANCE)), jnp.argmax(mask).astype(jnp.int32)
    return jax.lax.scan(choose, start, length=count)[1]


# These values take the place of distances for chosen and for empty rows. If the bits of floats are read as integers,
# -1.0 is smaller than -2.0, and both are smaller than any distance. So a chosen row is preferred to an empty row.
_CHOSEN_DISTANCE, _EMPTY_DISTANCE = -2.0, -1.0
# An array is cut into this many parts, which are first reduced elementwise to one part. On a CPU this is several times
# as fast as reducing the whole array.
_NUM_PARTS = 8


def _first_of_largest(distance: Float[Array, " n"], rows: Int[Array, " n"]) -> Int[Array, ""]:
    """Return the argmax of `distance`, computed by comparing the bits of the floats as integers.

    The bits of floats that are not negative are in the order of the floats. On a CPU, a maximum of integers and then a
    minimum of row indices are several times as fast as `jnp.argmax`.
    """
    bits = jax.lax.bitcast_convert_type(distance, jnp.dtype(f"int{8 * distance.dtype.itemsize}"))
    largest = jnp.max(_reduce_parts(jnp.maximum, bits))
    return jnp.min(_reduce_parts(jnp.minimum, jnp.where(bits == largest, rows, len(rows))))


def _reduce_parts(operation: Callable[[Array, Array], Array], values: Array) -> Array:
    return functools.reduce(operation, jnp.split(values, _NUM_PARTS))
