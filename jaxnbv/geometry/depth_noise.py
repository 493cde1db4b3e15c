"""Estimation of each pixel's noise in a depth image, which depends on the distance and the material."""

import functools
import math
import operator
from statistics import NormalDist

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

# The image is divided into at most 40 x 40 square tiles of at least 8 x 8 pixels, and depths into steps of 10 %. The
# noise of a pixel is estimated from its tile and the eight around it, at its depth step and the two steps beside it.
_MAX_TILES, _MIN_TILE_SIZE = 40, 8
_DEPTH_STEP, _DEPTH_STEPS = math.log(1.1), 48
# Third differences, divided by the depth, are counted in `_LEVELS` bins. The first bin ends at `_MIN_DIFFERENCE`, and
# each later bin ends at twice the end of the bin before it. Larger differences come from edges and are not counted.
_MIN_DIFFERENCE, _LEVELS = 1e-5, 16
_MIN_COUNT = 16
# Median magnitude of the third difference of independent normal errors, divided by the standard deviation of one error.
_MEDIAN_SIZE = math.sqrt(20.0) * NormalDist().inv_cdf(0.75)


def depth_noise(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], min_noise: float | Float[Array, ""]
) -> Float[Array, "h w"]:
    """Return the standard deviation of each pixel's noise and rounding, in units of the depth.

    The noise is estimated from the median magnitude of third differences of depth along rows and columns, which are
    mostly noise on a smooth surface. The median is over differences near the pixel at a similar depth. If there are
    fewer than 16, it is over the whole image at a similar depth or, if there are still fewer than 16, at any depth. If
    between half and three quarters of the differences are zero, depths are assumed to be rounded, and the median is
    over the other differences. If more are zero, the median is nearly zero. The result is at least `min_noise`.
    """
    tile = max(-(-max(depth.shape) // _MAX_TILES), _MIN_TILE_SIZE)
    tiles = tuple(-(-size // tile) for size in depth.shape)
    # Depth steps are relative to the nearest pixel, so that the unit of the depth does not matter.
    nearest = jnp.min(jnp.where(valid, depth, jnp.inf))
    step = jnp.floor(jnp.log(jnp.where(valid, depth / nearest, 1.0)) / _DEPTH_STEP).astype(jnp.int32) % _DEPTH_STEPS
    row, column = (index // tile for index in jnp.indices(depth.shape))
    cell = row, column, step
    counts = jnp.zeros((*tiles, _DEPTH_STEPS, _LEVELS), depth.dtype)
    for axis in (0, 1):
        # Differences use every second pixel, because sensors smooth their images and so correlate the errors of direct
        # neighbours.
        a, b, c, d = (_group_member(depth, axis, index) for index in range(4))
        is_smooth = functools.reduce(operator.and_, (_group_member(valid, axis, index) for index in range(4)))
        # Pixels beside an edge are left out, since they mix a near and a far surface.
        is_smooth &= functools.reduce(operator.and_, (jnp.abs(other - a) <= _DEPTH_STEP * a for other in (b, c, d)))
        size = jnp.abs(d - 3.0 * c + 3.0 * b - a) / jnp.where(is_smooth, a, 1.0)
        level = 1 + jnp.floor(jnp.log2(jnp.maximum(size / _MIN_DIFFERENCE, 0.5))).astype(jnp.int32)
        group_cell = (_group_member(index, axis, 0) for index in cell)
        counts = counts.at[*group_cell, jnp.where(is_smooth, level, _LEVELS)].add(1.0, mode="drop")
    counts = counts + jnp.roll(counts, 1, axis=2) + jnp.roll(counts, -1, axis=2)
    window_counts = jax.lax.reduce_window(counts, 0.0, jax.lax.add, (3, 3, 1, 1), (1, 1, 1, 1), "SAME")
    for axes in ((0, 1), (0, 1, 2)):
        is_few = jnp.sum(window_counts, axis=-1, keepdims=True) < _MIN_COUNT
        window_counts = jnp.where(is_few, jnp.sum(counts, axis=axes, keepdims=True), window_counts)
    median = _median(window_counts)
    return jnp.maximum(depth * median[*cell] / _MEDIAN_SIZE, min_noise)


def _group_member(image: Shaped[Array, "h w"], axis: int, index: int) -> Shaped[Array, "k l"]:
    """Return the image whose entry i along an axis is entry i + 2 `index` of `image` (`index` 0 to 3)."""
    members = slice(2 * index, 2 * index + max(image.shape[axis] - 6, 0))
    return image[members] if axis == 0 else image[:, members]


def _median(counts: Float[Array, "*n levels"]) -> Float[Array, "*n"]:
    """Return the median of a histogram whose bins are powers of two; zero for an empty histogram.

    The median is interpolated linearly within its bin. The first bin counts numbers that are nearly zero. It is left
    out if it has between half and three quarters of all numbers, see `depth_noise`.
    """
    zeros = counts[..., 0] / jnp.maximum(jnp.sum(counts, axis=-1), 1.0)
    counts = counts.at[..., 0].multiply((zeros < 0.5) | (zeros > 0.75))
    cumulative = jnp.cumsum(counts, axis=-1)
    half = 0.5 * cumulative[..., -1:]
    level = jnp.argmax(cumulative >= half, axis=-1, keepdims=True)
    count = jnp.take_along_axis(counts, level, axis=-1)
    fraction = (half - (jnp.take_along_axis(cumulative, level, axis=-1) - count)) / jnp.maximum(count, 1.0)
    return jnp.where(half > 0, _MIN_DIFFERENCE * 2.0 ** (level - 1.0) * (1.0 + fraction), 0.0)[..., 0]
