"""Sampling of depth images with gaps between valid pixels, such as images of a lidar."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import correlate

# Sides of blocks to try, in pixels. A side fits if the fraction of blocks with a valid pixel is at least
# `_MIN_FILLED_RATIO` times the fraction for blocks of four times the side.
_SIDES, _MIN_FILLED_RATIO = (2, 3, 4, 6, 8, 12, 16, 24), 0.7
# An image has no gaps if at least the fraction `_MIN_PLANE_FRACTION` of its valid pixels have enough neighbours for a
# plane: `_MIN_PLANE_PIXELS` valid pixels in their 3 x 3 neighbourhood, themselves included.
_MIN_PLANE_FRACTION, _MIN_PLANE_PIXELS = 0.8, 4


def find_block_side(valid: Bool[np.ndarray, "h w"]) -> int:
    """Return the side, in pixels, of square blocks that are as large as the gaps between valid pixels.

    The side is 1 if most valid pixels have enough valid neighbours for a plane, even if the image has holes. Otherwise
    it is the smallest side for which blocks contain a valid pixel about as often as blocks of four times the side. For
    example, it is 8 if only every eighth row is valid.
    """
    num_valid = correlate(valid.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant")
    if not valid.any() or np.mean(num_valid[valid] >= _MIN_PLANE_PIXELS) >= _MIN_PLANE_FRACTION:
        return 1

    def filled_fraction(side: int) -> float:
        height, width = (side * (size // side) for size in valid.shape)
        blocks = valid[:height, :width].reshape(height // side, side, width // side, side)
        return float(blocks.any(axis=(1, 3)).mean()) if blocks.size else 0.0

    return next(
        (side for side in _SIDES if filled_fraction(side) >= _MIN_FILLED_RATIO * filled_fraction(4 * side)), _SIDES[-1]
    )


def block_samples(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], side: int
) -> tuple[Float[Array, "k l"], Bool[Array, "k l"], Int[Array, "k l 2"]]:
    """Choose a sample in each square block of an image: the valid pixel nearest to the block's middle.

    Return the depth of each block's sample, whether there is a sample, and its column and row within the block.
    """
    if side == 1:
        return depth, valid, jnp.zeros((*depth.shape, 2), int)

    def blocks(image):
        image = jnp.pad(image, [(0, -size % side) for size in image.shape])
        height, width = (size // side for size in image.shape)
        return image.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)

    row, column = np.divmod(np.arange(side * side), side)
    squared_distances = (row - 0.5 * (side - 1)) ** 2 + (column - 0.5 * (side - 1)) ** 2
    index = jnp.argmin(jnp.where(blocks(valid), squared_distances, jnp.inf), axis=-1)
    offset = jnp.stack([jnp.asarray(column)[index], jnp.asarray(row)[index]], axis=-1)
    samples = jnp.take_along_axis(blocks(depth), index[..., None], axis=-1)[..., 0]
    return samples, blocks(valid).any(axis=-1), offset
