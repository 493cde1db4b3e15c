"""Noise of each pixel of a depth image. It grows with the distance and depends on the material."""

import functools
import math
import operator
from statistics import NormalDist

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

# Noise is estimated from a tile of pixels and the eight tiles around it, over three steps of 10 % in depth.
_TILES, _SMALLEST_TILE = 40, 8
_DEPTH_STEP, _DEPTH_STEPS = math.log(1.1), 48
# Third differences, divided by the depth, are counted by powers of two from this one on. The largest are edges.
_LEAST_DIFFERENCE, _LEVELS = 1e-5, 16
_ENOUGH = 16
# Median size of the third difference of independent errors, over the standard deviation of one error.
_MEDIAN_SIZE = math.sqrt(20.0) * NormalDist().inv_cdf(0.75)


def depth_noise(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], least: float | Float[Array, ""]
) -> Float[Array, "h w"]:
    """Standard deviation of each pixel's noise and rounding, in units of the depth; at least `least`.

    It follows from the median of third differences along rows and columns, which are mostly noise on smooth surface.
    The differences are those near the pixel and at its depth. If these are few, all of the image at this depth count,
    and if these are few too, those at all depths. If half or more of them are zero but a quarter is not, the depth is
    in steps, whose size follows from the ones that are not zero.
    """
    tile = max(-(-max(depth.shape) // _TILES), _SMALLEST_TILE)
    tiles = tuple(-(-size // tile) for size in depth.shape)
    # Relative to the nearest pixel, so that the unit of the depth does not matter.
    nearest = jnp.min(jnp.where(valid, depth, jnp.inf))
    step = jnp.floor(jnp.log(jnp.where(valid, depth / nearest, 1.0)) / _DEPTH_STEP).astype(jnp.int32) % _DEPTH_STEPS
    row, column = (index // tile for index in jnp.indices(depth.shape))
    cell = row, column, step
    counts = jnp.zeros((*tiles, _DEPTH_STEPS, _LEVELS), depth.dtype)
    for axis in (0, 1):
        # Every second pixel, since sensors smooth their images and the errors of neighbours are correlated.
        a, b, c, d = (_every_second(depth, axis, index) for index in range(4))
        is_smooth = functools.reduce(operator.and_, (_every_second(valid, axis, index) for index in range(4)))
        # Beside an edge, pixels mix a near and a far surface.
        is_smooth &= functools.reduce(operator.and_, (jnp.abs(other - a) <= _DEPTH_STEP * a for other in (b, c, d)))
        size = jnp.abs(d - 3.0 * c + 3.0 * b - a) / jnp.where(is_smooth, a, 1.0)
        level = 1 + jnp.floor(jnp.log2(jnp.maximum(size / _LEAST_DIFFERENCE, 0.5))).astype(jnp.int32)
        place = (_every_second(index, axis, 0) for index in cell)
        counts = counts.at[*place, jnp.where(is_smooth, level, _LEVELS)].add(1.0, mode="drop")
    counts = counts + jnp.roll(counts, 1, axis=2) + jnp.roll(counts, -1, axis=2)
    near = jax.lax.reduce_window(counts, 0.0, jax.lax.add, (3, 3, 1, 1), (1, 1, 1, 1), "SAME")
    for axes in ((0, 1), (0, 1, 2)):
        few = jnp.sum(near, axis=-1, keepdims=True) < _ENOUGH
        near = jnp.where(few, jnp.sum(counts, axis=axes, keepdims=True), near)
    median = _median(near)
    return jnp.maximum(depth * median[*cell] / _MEDIAN_SIZE, least)


def _every_second(image: Shaped[Array, "h w"], axis: int, index: int) -> Shaped[Array, "k l"]:
    """The pixel with this index (0 to 3) of each four pixels that are two apart along an axis."""
    kept = slice(2 * index, 2 * index + max(image.shape[axis] - 6, 0))
    return image[kept] if axis == 0 else image[:, kept]


def _median(counts: Float[Array, "*n levels"]) -> Float[Array, "*n"]:
    """The median of numbers counted by powers of two, linear within one; zero if there are none.

    Numbers at the first level are left out if they are between a half and three quarters of all.
    """
    zeros = counts[..., 0] / jnp.maximum(jnp.sum(counts, axis=-1), 1.0)
    counts = counts.at[..., 0].multiply((zeros < 0.5) | (zeros > 0.75))
    below = jnp.cumsum(counts, axis=-1)
    half = 0.5 * below[..., -1:]
    level = jnp.argmax(below >= half, axis=-1, keepdims=True)
    inside = jnp.take_along_axis(counts, level, axis=-1)
    share = (half - (jnp.take_along_axis(below, level, axis=-1) - inside)) / jnp.maximum(inside, 1.0)
    return jnp.where(half > 0, _LEAST_DIFFERENCE * 2.0 ** (level - 1.0) * (1.0 + share), 0.0)[..., 0]
