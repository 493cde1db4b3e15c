"""Which rows a set abstraction looks at around each of its centres (Qi et al. 2017)."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import require

_WORD = 32


@functools.partial(jax.jit, static_argnames="count")
def ball_query(
    centers: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    radius: float | Float[Array, ""],
    count: int,
) -> Int[Array, "m count"]:
    """The first `count` rows within `radius` of each centre, in order of rows; the first of them fills what is left.

    A point at exactly `radius` is within. A centre that has no point within gets the first filled row. Indices carry no
    derivative; points and features get theirs through `points[index]`.

    **Raises:** `ValueError` if `count` < 1.
    """
    require(count >= 1, f"cannot group {count} points; ask for at least one")
    centers, points = jax.lax.stop_gradient((centers, points))
    offsets = ((a[:, None] - b) ** 2 for a, b in zip(centers.T, points.T, strict=True))
    index = _positions_of_true((sum(offsets) <= radius**2) & mask, count)
    nearest = jnp.where(index[:, :1] < len(points), index[:, :1], jnp.argmax(mask).astype(index.dtype))
    return jnp.where(index < len(points), index, nearest)


def _positions_of_true(flags: Bool[Array, "m n"], count: int) -> Int[Array, "m count"]:
    """Columns of the first `count` true entries of each row, n or more where there are no more.

    The row is packed into words of 32 bits: the numbers of bits in the words say which word holds the k-th entry, and
    five halvings of the word where in it. This costs one pass over the flags; sorting the columns costs many.
    """
    flags = jnp.pad(flags, ((0, 0), (0, -flags.shape[1] % _WORD))).reshape(len(flags), -1, _WORD)
    bit = jnp.left_shift(jnp.uint32(1), jnp.arange(_WORD, dtype=jnp.uint32))
    words = jnp.sum(jnp.where(flags, bit, jnp.uint32(0)), axis=-1, dtype=jnp.uint32)
    through = jnp.cumsum(_bit_count(words), axis=1)

    wanted = jnp.arange(count, dtype=jnp.int32)
    word = jnp.sum(through[:, None, :] <= wanted[:, None], axis=-1, dtype=jnp.int32)
    before = jnp.where(word > 0, jnp.take_along_axis(through, jnp.maximum(word - 1, 0), axis=1), 0)
    left = jnp.take_along_axis(words, jnp.minimum(word, words.shape[1] - 1), axis=1)
    rank, column = wanted - before, _WORD * word
    for half in (16, 8, 4, 2, 1):
        lower = _bit_count(left & jnp.uint32((1 << half) - 1))
        above = lower <= rank
        rank = jnp.where(above, rank - lower, rank)
        left = jnp.where(above, left >> half, left)
        column = jnp.where(above, column + half, column)
    return column


def _bit_count(words):
    return jax.lax.population_count(words).astype(jnp.int32)
