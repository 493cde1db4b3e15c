"""Samples of depth images with gaps between pixels, from lidars or images aligned to a finer camera."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import correlate

# Sides of blocks. Blocks must be filled at least this share as often as blocks of four times the side.
_SIDES, _FILLED = (2, 3, 4, 6, 8, 12, 16, 24), 0.7
# Without gaps, at least this share of the pixels has enough valid pixels around it for a plane: four of nine.
_WITH_PLANE, _FEWEST = 0.8, 4


def gap_of(valid: Bool[np.ndarray, "h w"]) -> int:
    """The gap between a depth image's pixels: the side of blocks with one sample each; 1 for no gap.

    There is no gap if most valid pixels have enough neighbours for a plane, whatever holes the image has. Otherwise it
    is the least side for which blocks are filled about as often as blocks of four times the side: 8 if every eighth row
    is valid.
    """
    around = correlate(valid.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant")
    if not valid.any() or np.mean(around[valid] >= _FEWEST) >= _WITH_PLANE:
        return 1

    def filled(side: int) -> float:
        height, width = (side * (size // side) for size in valid.shape)
        blocks = valid[:height, :width].reshape(height // side, side, width // side, side)
        return float(blocks.any(axis=(1, 3)).mean()) if blocks.size else 0.0

    return next((side for side in _SIDES if filled(side) >= _FILLED * filled(4 * side)), _SIDES[-1])


def block_samples(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], side: int
) -> tuple[Float[Array, "k l"], Bool[Array, "k l"], Int[Array, "k l 2"]]:
    """Depth of each block's valid pixel nearest to its middle, whether there is one, and its place.

    - `side`: side of the blocks in pixels. The place is the column and the row within the block.
    """
    if side == 1:
        return depth, valid, jnp.zeros((*depth.shape, 2), int)

    def blocks(image):
        image = jnp.pad(image, [(0, -size % side) for size in image.shape])
        height, width = (size // side for size in image.shape)
        return image.reshape(height, side, width, side).swapaxes(1, 2).reshape(height, width, side * side)

    row, column = np.divmod(np.arange(side * side), side)
    off = (row - 0.5 * (side - 1)) ** 2 + (column - 0.5 * (side - 1)) ** 2
    chosen = jnp.argmin(jnp.where(blocks(valid), off, jnp.inf), axis=-1)
    place = jnp.stack([jnp.asarray(column)[chosen], jnp.asarray(row)[chosen]], axis=-1)
    samples = jnp.take_along_axis(blocks(depth), chosen[..., None], axis=-1)[..., 0]
    return samples, blocks(valid).any(axis=-1), place
