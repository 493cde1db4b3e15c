"""Planes that are fitted to the neighbours of each pixel of a depth image, to reduce its noise.

On a plane, the inverse depth 1 / z is a linear function of the point (u, v) where a ray meets depth 1. For each pixel,
with depth z0 at (u0, v0), the coefficients a, b and c of

    z0 / z(u, v) = a + b (u - u0) + c (v - v0)

are fitted by least squares to the pixels of a window that can belong to the same surface. The plane's normal is along
(b, c, a - b u0 - c v0). If neighbouring pixels are a distance p apart on the surface, and their depths have noise of
standard deviation sigma, a slope that is fitted to a window of (2 r + 1)^2 pixels has a standard error of

    sqrt(3) sigma / (p r (2 r + 1)).

The radius r of the window is the smallest for which this error is below 2.5 degrees, but at most 10.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.depth_noise import depth_noise
from jaxnbv.geometry.gaps import block_samples

_MAX_RADIUS = 10
_MAX_SLOPE_ERROR = math.radians(2.5)
# A neighbour can be on the same surface if its depth differs from the pixel's by at most `_MAX_SLOPE` times their
# distance perpendicular to the axis (a slope of 76 degrees), plus `_MAX_DEVIATIONS` standard deviations of the noise.
_MAX_SLOPE, _MAX_DEVIATIONS = 4.0, 6.0
_MIN_PIXELS = 4
# The depths of two pixels of one surface rarely differ by more than `_MAX_DIFFERENCE` standard deviations of the noise.
# If a pixel differs by more from more than `_MAX_UNLIKE` of its eight neighbours, it mixes a near and a far surface.
_MAX_DIFFERENCE, _MAX_UNLIKE = 3.0 * math.sqrt(2.0), 5


def fit_planes(
    depth: Float[Array, "h w"],
    valid: Bool[Array, "h w"],
    camera: Camera,
    stride: int,
    min_noise: float | Float[Array, ""],
    block_side: int = 1,
) -> tuple[Float[Array, "k l"], Float[Array, "k l 3"], Bool[Array, "k l"]]:
    """Fit a plane to the window around each pixel of every `stride`-th row and column.

    Return, for each of these pixels, the plane's depth and normal at the pixel, and whether there is a plane. There is
    none if the window has too few pixels or only pixels along a line, or if the pixel mixes two surfaces. Normals are
    in the camera's frame and point towards the camera. In an image without gaps, the returned depth differs from the
    measured depth by at most three standard deviations of the noise.

    - `depth`: depths, positive and finite where `valid`.
    - `camera`: the camera of the whole image.
    - `min_noise`: lower bound on the standard deviation of the noise, such as that of rounding.
    - `block_side`: side, in pixels, of the blocks that make up a window. Each is reduced to one point of the fit.
    """
    focal = jnp.asarray(camera.focal_lengths, depth.dtype)
    strided = slice(stride // 2, None, stride)
    plane_points = camera.pixel_directions().reshape(*depth.shape, 3)[strided, strided, :2].astype(depth.dtype)
    pixels = [jnp.arange(stride // 2, size, stride) for size in depth.shape]
    rows, columns = (_MAX_RADIUS + pixel // block_side for pixel in pixels)
    samples, is_sample, offset = block_samples(depth, valid, block_side)
    sigma = depth_noise(samples, is_sample, min_noise)[(pixels[0] // block_side)[:, None], pixels[1] // block_side]
    padded = jnp.pad(jnp.where(is_sample, samples, 0.0), _MAX_RADIUS)
    offset = jnp.pad(offset, ((_MAX_RADIUS, _MAX_RADIUS), (_MAX_RADIUS, _MAX_RADIUS), (0, 0)))
    block_offset = jnp.stack(jnp.meshgrid(pixels[1] % block_side, pixels[0] % block_side), axis=-1)
    # `sample_offset` is the offset (column, row) in pixels from each pixel to the sample of its block.
    sample_offset = offset[rows[:, None], columns[None]] - block_offset
    middle, has_middle = padded[rows[:, None], columns[None]], padded[rows[:, None], columns[None]] > 0
    middle = jnp.where(has_middle, middle, 1.0)
    spacing = middle[..., None] / focal
    radius = _radius(block_side * jnp.min(spacing, axis=-1), sigma)
    window = (block_side * radius)[..., None]
    width = 2 * jnp.max(jnp.where(has_middle, radius, 1)) + 1

    def add(index, sums):
        """Add one neighbour of each pixel to the sums of that pixel, if both can be on one surface.

        - `index`: index of the neighbour in the window.
        - `sums`: matrix and right-hand side of the normal equations, and number of adjacent pixels that differ by more
          than noise. Positions are in units of the window's radius.
        """
        row_step, column_step = index // width - width // 2, index % width - width // 2
        neighbour = padded[(rows + row_step)[:, None], (columns + column_step)[None]]
        position = block_side * jnp.stack([column_step, row_step]) - block_offset
        position = position + offset[(rows + row_step)[:, None], (columns + column_step)[None]]
        lateral = jnp.linalg.norm(spacing * (position - sample_offset), axis=-1)
        excess = jnp.abs(neighbour - middle) - _MAX_SLOPE * lateral
        distance = jnp.maximum(jnp.abs(row_step), jnp.abs(column_step))
        is_included = has_middle & (neighbour > 0) & (excess <= _MAX_DEVIATIONS * sigma) & (distance <= radius)
        is_unlike = (neighbour > 0) & (excess > _MAX_DIFFERENCE * sigma) & (distance == 1)
        row = jnp.stack(jnp.broadcast_arrays(1.0, *jnp.moveaxis(position / window, -1, 0)), axis=-1)
        row = jnp.where(is_included[..., None], row.astype(depth.dtype), 0.0)
        ratio = middle / jnp.where(is_included, neighbour, 1.0)
        return sums[0] + row[..., :, None] * row[..., None, :], sums[1] + ratio[..., None] * row, sums[2] + is_unlike

    zeros = *(jnp.zeros(middle.shape + shape, depth.dtype) for shape in ((3, 3), (3,))), jnp.zeros(middle.shape, int)
    normal, right_hand, num_unlike = jax.lax.fori_loop(0, width * width, add, zeros)
    # Pixels along a line do not define a plane.
    has_plane = (normal[..., 0, 0] >= _MIN_PIXELS) & (_breadth(normal) > 1e-3) & (num_unlike <= _MAX_UNLIKE)
    regular = jnp.where(has_plane[..., None, None], normal, jnp.eye(3, dtype=depth.dtype))
    plane = jnp.linalg.solve(regular, right_hand[..., None])[..., 0]
    has_plane = has_plane & (plane[..., 0] > 0)
    # Convert slopes per radius of the window to slopes per unit of (u, v).
    slope = plane[..., 1:] * focal / window
    direction = jnp.concatenate(
        [slope, plane[..., :1] - jnp.sum(slope * plane_points, axis=-1, keepdims=True)], axis=-1
    )
    length = jnp.linalg.norm(direction, axis=-1, keepdims=True)
    max_shift = 3.0 * sigma + _MAX_SLOPE * jnp.linalg.norm(spacing * sample_offset, axis=-1)
    smooth = jnp.clip(middle / jnp.where(has_plane, plane[..., 0], 1.0), middle - max_shift, middle + max_shift)
    return smooth, -direction / jnp.where(length > 0, length, 1.0), has_plane & (length[..., 0] > 0)


def _radius(spacing: Float[Array, "k l"], sigma: Float[Array, "k l"]) -> Int[Array, "k l"]:
    """Return each pixel's radius (up to `_MAX_RADIUS`) of the smallest window with an accurate slope.

    - `spacing`: distance between neighbouring pixels on the surface.
    - `sigma`: standard deviation of the noise of the depth.
    """
    radii = jnp.arange(1, _MAX_RADIUS + 1)
    error = math.sqrt(3.0) * sigma[..., None] / (spacing[..., None] * radii * (2 * radii + 1))
    return jnp.minimum(1 + jnp.sum(error > _MAX_SLOPE_ERROR, axis=-1), _MAX_RADIUS)


def _breadth(normal: Float[Array, "k l 3 3"]) -> Float[Array, "k l"]:
    """Return how evenly neighbours spread about their mean, from 0 (on a line) to 1 (in all directions).

    - `normal`: matrix of the normal equations of the plane through the neighbours.
    """
    total = jnp.maximum(normal[..., 0, 0], 1e-12)
    mean = normal[..., 0, 1:] / total[..., None]
    covariance = normal[..., 1:, 1:] / total[..., None, None] - mean[..., :, None] * mean[..., None, :]
    trace, determinant = covariance[..., 0, 0] + covariance[..., 1, 1], jnp.linalg.det(covariance)
    return 4.0 * determinant / jnp.maximum(trace**2, 1e-12)
