"""OpenCV's lens distortion with 4, 5 or 8 coefficients (Brown 1971), and its removal from images.

A lens shows a point (X, Y, Z) of the camera's frame at the point (x', y') of the plane Z = 1. With x = X / Z, y = Y / Z
and r^2 = x^2 + y^2,

    x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),    y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y,
    g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import AnyArray, as_numbers, require
from jaxnbv.programs import program

_SHAPES = ((4,), (5,), (8,))
# Neighbouring depths are not averaged if their relative difference exceeds both `_MAX_DIFFERENCE` and `_MAX_SLOPE`
# divided by the focal length in pixels.
_MAX_DIFFERENCE, _MAX_SLOPE = 0.01, 4.0
# Lenses of depth cameras move a point by at most a third of its distance from the axis. So each iteration reduces the
# error to about a third.
_ITERATIONS = 25


def distort_points(
    x: Float[AnyArray, "*n"], y: Float[AnyArray, "*n"], coefficients: tuple[float, ...]
) -> tuple[Float[AnyArray, "*n"], Float[AnyArray, "*n"]]:
    """Return the distorted coordinates of points (x, y) in the plane Z = 1."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))
    r2 = x**2 + y**2
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    x_distorted = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    y_distorted = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return x_distorted, y_distorted


def undistort_points(
    x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"], coefficients: tuple[float, ...]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Invert `distort_points` by fixed-point iteration, as in OpenCV."""
    x_true, y_true = x, y
    for _ in range(_ITERATIONS):
        x_distorted, y_distorted = distort_points(x_true, y_true, coefficients)
        x_true, y_true = x_true + x - np.asarray(x_distorted), y_true + y - np.asarray(y_distorted)
    return x_true, y_true


def pixels_of(
    plane_points: Float[AnyArray, "*n 2"], matrix: Float[AnyArray, "3 3"], coefficients: tuple[float, ...]
) -> tuple[Float[AnyArray, "*n"], Float[AnyArray, "*n"]]:
    """Return the column and row at which a distorted image shows each point (x, y) of the plane Z = 1."""
    x, y = distort_points(plane_points[..., 0], plane_points[..., 1], coefficients)
    return x * matrix[0, 0] + matrix[0, 2], y * matrix[1, 1] + matrix[1, 2]


def check_distortion(coefficients: tuple[float, ...], radius: float) -> None:
    """Check that distortion coefficients are valid within `radius` of the axis, in the plane Z = 1.

    **Raises:** `ValueError` if there are not four, five or eight coefficients, if one is not finite, or if the
    distorted distance from the axis does not grow with the true distance.
    """
    array = as_numbers(coefficients, "the distortion", np.float64)
    require(
        isinstance(coefficients, tuple) and array.shape in _SHAPES and bool(np.isfinite(array).all()),
        f"the distortion is {coefficients}: give OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]], or () for none",
    )
    radial = (*coefficients[:2], 0.0, 0.0, *coefficients[4:])
    distorted_radii, _ = distort_points(np.linspace(0.0, radius, 100), np.zeros(100), radial)
    require(
        bool((np.diff(np.asarray(distorted_radii)) > 0).all()),
        f"the distortion {coefficients} folds the image: give OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]] in this "
        "order, of this camera",
    )


@program
def undistort_image(
    depth: Float[Array, "h w"],
    missed: Bool[Array, "h w"],
    plane_points: Float[Array, "h w 2"],
    matrix: Float[Array, "3 3"],
    coefficients: tuple[float, ...],
) -> tuple[Float[Array, "h w"], Bool[Array, "h w"]]:
    """Return a depth image with its distortion removed, and whether each ray of the new image met nothing.

    Each new depth is interpolated linearly in 1 / depth between the four nearest pixels of the distorted image. If
    these pixels are not on one surface, the depth of the nearest pixel is taken. It is 0 outside the distorted image.

    - `depth`, `missed`: depths of the distorted image (positive and finite if valid), and whether its rays met nothing.
    - `plane_points`: positions of the new image's pixels in the plane Z = 1.
    - `matrix`: intrinsic matrix of both images.
    """
    focal = jnp.diagonal(matrix)[:2]
    column, row = (jnp.asarray(pixel) for pixel in pixels_of(plane_points, matrix, coefficients))
    height, width = depth.shape
    is_inside = (column > -0.5) & (column < width - 0.5) & (row > -0.5) & (row < height - 0.5)
    nearest = jnp.round(row).astype(int).clip(0, height - 1), jnp.round(column).astype(int).clip(0, width - 1)

    top, left = jnp.floor(row).astype(int).clip(0, height - 2), jnp.floor(column).astype(int).clip(0, width - 2)
    valid = jnp.where(jnp.isfinite(depth) & (depth > 0), depth, 0.0)
    corners = jnp.stack([valid[top + i, left + j] for i in (0, 1) for j in (0, 1)])
    low, high = jnp.min(corners, axis=0), jnp.max(corners, axis=0)
    is_alike = (low > 0) & (high <= low * (1.0 + jnp.maximum(_MAX_DIFFERENCE, _MAX_SLOPE / jnp.min(focal))))
    dy, dx = row - top, column - left
    weights = jnp.stack([(1 - dy) * (1 - dx), (1 - dy) * dx, dy * (1 - dx), dy * dx])
    smooth = 1.0 / jnp.sum(weights / jnp.where(is_alike, corners, 1.0), axis=0)
    return jnp.where(is_inside, jnp.where(is_alike, smooth, depth[nearest]), 0.0), is_inside & missed[nearest]
