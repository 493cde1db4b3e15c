"""Conversion of a depth image to points with normals, missed rays, and distances to the hits of rays."""

import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Real

from jaxnbv.checks import AnyArray, as_floats, as_numbers, is_traced, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.distortion import undistort_image
from jaxnbv.geometry.gaps import block_samples, find_block_side
from jaxnbv.geometry.plane_fit import fit_planes
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.sentinels import sentinel_pixels
from jaxnbv.geometry.volume import Box, ray_interval
from jaxnbv.programs import program

Rows = tuple[Float[Array, "n 3"], Float[Array, "n 3"], Bool[Array, " n"], Bool[Array, " n"], Float[Array, " n"]]
# The units count as right if at least the fraction `_MIN_FRACTION` of the depths is within a factor of
# `_MAX_DEPTH_RATIO` of the box's depths.
_MAX_DEPTH_RATIO, _MIN_FRACTION = 20.0, 1e-3
# A value may be a sentinel ("not measured") if it exceeds the box's greatest depth by this factor. The surface that the
# object stands on is nearer.
_SENTINEL_DEPTH_RATIO = 1.1


class NothingInside(UserWarning):
    """The warning that no point of a depth image lies in the box."""


def points_of_depth(
    depth: Real[AnyArray, "height width"], camera: Camera, pose: Pose, scale: float, stride: int, box: Box | None
) -> Rows:
    """Return the points, normals, mask, missed and sight of the cloud that `PointCloud.from_depth` makes.

    **Raises:** `ValueError` for a scale that is not positive, a batch of poses, a stride that is below one or leaves no
    pixel, or for the same reasons as `from_depth`.
    """
    shape = (camera.height, camera.width)
    # Infinite depths are detected before a conversion that may round large numbers to infinity.
    numbers = depth if is_traced(depth) else as_numbers(depth, "the depth image", None)
    missed = numbers == np.inf
    rounding = scale / math.sqrt(12.0) if np.issubdtype(numbers.dtype, np.integer) else 0.0
    depth = scale * as_floats(numbers, "the depth image")
    require(
        depth.shape == shape,
        f"the depth image is {depth.shape} but the camera has {shape} pixels: give Camera(height=..., width=...) of "
        "the image",
    )
    require(scale > 0, f"the depth's scale is {scale}; it must be positive")
    require(pose.position.ndim == 1, f"the pose is a batch {pose.position.shape[:-1]}: give one, such as poses[0]")
    # Reject an invalid stride before any other computation.
    camera.strided(stride)
    if not is_traced(depth, pose):
        depth_range = None if box is None else _depth_range(box, pose)
        values = np.where(_is_sentinel(np.asarray(numbers), camera, scale, depth_range), 0.0, depth)
        depth = jnp.asarray(values)
        _check_units(values[np.isfinite(values) & (values > 0)], camera, depth_range)
    if camera.distortion:
        plane_points = camera.pixel_directions().reshape(*shape, 3)[..., :2]
        matrix = jnp.asarray(camera.intrinsics, depth.dtype)
        depth, missed = undistort_image(depth, jnp.asarray(missed), plane_points, matrix, camera.distortion)
    block_side = 1 if is_traced(depth) else find_block_side(np.isfinite(depth) & (np.asarray(depth) > 0))
    # The rounding is an array, so that a program compiled for one unit of depth runs for any unit.
    image = depth, jnp.asarray(missed), camera, pose, stride, jnp.asarray(rounding, depth.dtype), block_side
    (points, normals, mask, missed, sight), nearest = _points_and_normals(*image)
    if box is not None:
        inside, crosses_box = _in_box(points, nearest, box, camera, pose, stride)
        if not is_traced(points):
            _warn_of_nothing_inside(np.asarray(points)[np.asarray(mask)], np.asarray(inside)[np.asarray(mask)], box)
        mask, missed = mask & inside, missed | (crosses_box & ~inside)
    points, normals = (jnp.where(mask[:, None], vectors, 0.0) for vectors in (points, normals))
    return points, normals, mask, missed, sight


@program
def _points_and_normals(
    depth: Float[Array, "h w"],
    missed: Bool[Array, "h w"],
    camera: Camera,
    pose: Pose,
    stride: int,
    rounding: Float[Array, ""],
    block_side: int,
) -> tuple[Rows, Float[Array, " n"]]:
    """Return the arrays of a cloud, and a lower bound on the depth near each of its points.

    All arrays have one entry for every `stride`-th row and column. The bound is -inf where no depth is measured.

    - `rounding`: standard deviation of the rounding of depths.
    """
    rows, strided_camera = slice(stride // 2, None, stride), camera.strided(stride)
    samples = _strided_samples(depth, jnp.isfinite(depth) & (depth > 0), stride, block_side)[0]
    sight = jnp.where(samples > 0, samples, jnp.inf).reshape(-1)
    sight = sight * jnp.linalg.norm(strided_camera.pixel_directions(), axis=-1)
    valid = jnp.isfinite(depth) & (depth > 0)
    if camera.farthest is not None:
        missed = missed | (valid & (depth > camera.farthest))
    valid = valid & ~missed & (depth >= camera.nearest)
    smooth, normals, has_normal = fit_planes(jnp.where(valid, depth, 0.0), valid, camera, stride, rounding, block_side)
    depth, valid, nearest = _strided_samples(jnp.where(valid, depth, 0.0), valid, stride, block_side)
    missed = missed[rows, rows]
    mask = (valid & has_normal).reshape(-1)
    local = jnp.where(valid, jnp.where(has_normal, smooth, depth), 0.0).reshape(-1, 1)
    points = pose.to_scene(local * strided_camera.pixel_directions())
    normals = jnp.matmul(normals.reshape(-1, 3), pose.rotation.T, precision="highest")
    nearest = jnp.where(valid, nearest, -jnp.inf).reshape(-1)
    return (points, normals, mask, missed.reshape(-1), sight), nearest


@program
def _in_box(
    points: Float[Array, "n 3"], nearest: Float[Array, " n"], box: Box, camera: Camera, pose: Pose, stride: int
) -> tuple[Bool[Array, " n"], Bool[Array, " n"]]:
    """Return which points lie in the box, and which rays hit something behind or beside the box.

    - `points`, `nearest`: point of each ray, and lower bound on the depth in the pixels around the point.
    """
    is_beyond = (nearest > -jnp.inf) & (nearest >= _depth_behind(box, camera.strided(stride), pose))
    return box(points) <= 0, is_beyond


def _strided_samples(
    depth: Float[Array, "h w"], valid: Bool[Array, "h w"], stride: int, block_side: int
) -> tuple[Float[Array, "k l"], Bool[Array, "k l"], Float[Array, "k l"]]:
    """Return three arrays with one entry for every `stride`-th row and column of a depth image.

    `block_samples` divides the image into square blocks and chooses a valid pixel, the sample, in each. The entry of a
    pixel depends on the block that holds the pixel:

    1. depth of the block's sample.
    2. whether the block has a sample.
    3. lower bound on the depth near the pixel: the least sample of the block and, if `block_side` > 1, of the eight
       blocks around it; infinite without a sample.
    """
    samples, is_sample, _ = block_samples(depth, valid, block_side)
    nearest = jnp.where(is_sample, samples, jnp.inf)
    if block_side > 1:
        nearest = jax.lax.reduce_window(nearest, jnp.inf, jax.lax.min, (3, 3), (1, 1), "SAME")
    rows, columns = (jnp.arange(stride // 2, size, stride) // block_side for size in depth.shape)
    index = rows[:, None], columns[None]
    return samples[index], is_sample[index], nearest[index]


def _depth_behind(box: Box, camera: Camera, pose: Pose) -> Float[Array, " n"]:
    """Return the depth at which each ray leaves a box; -inf for a ray that misses the box."""
    directions = jnp.matmul(camera.pixel_directions(), pose.rotation.T, precision="highest")
    enter, leave = ray_interval(list(pose.position), list(directions.T), box.low, box.high)
    return jnp.where(leave > jnp.maximum(enter, 0.0), leave, -jnp.inf)


def without_sentinels(
    depth: Real[np.ndarray, "height width"], camera: Camera, pose: Pose, scale: float, box: Box
) -> Real[np.ndarray, "height width"]:
    """Return the depth image with zeros for sentinels, values such as 65535 that mean "not measured".

    A value much deeper than the box that fills many pixels counts as a sentinel (see `sentinel_pixels`).

    - `scale`: factor from the unit of `depth` to the unit of the camera's range, the pose and the box.

    **Raises:** `ValueError` if the box lies behind the camera.
    """
    return np.where(_is_sentinel(depth, camera, scale, _depth_range(box, pose)), 0, depth)


def _is_sentinel(
    depth: Real[np.ndarray, "h w"], camera: Camera, scale: float, depth_range: tuple[float, float] | None
) -> Bool[np.ndarray, "h w"]:
    farthest = np.inf if camera.farthest is None else camera.farthest
    background = np.inf if depth_range is None else _SENTINEL_DEPTH_RATIO * depth_range[1]
    return sentinel_pixels(depth, min(farthest, background) / scale)


def _depth_range(box: Box, pose: Pose) -> tuple[float, float]:
    """Return the least (but at least 0.001 of the greatest) and the greatest depth of a box's corners."""
    corners = np.stack(np.meshgrid(*zip(box.low, box.high, strict=True)), axis=-1).reshape(-1, 3)
    depths = (corners - np.asarray(pose.position)) @ np.asarray(pose.forward)
    farthest = float(depths.max())
    require(
        farthest > 0,
        f"the box {box} lies behind the camera at {np.asarray(pose.position)}: give the pose "
        'from camera to world, not its inverse, and its convention, Pose.from_matrix(matrix, "opengl")',
    )
    return max(float(depths.min()), 1e-3 * farthest), farthest


def _check_units(depth: Float[np.ndarray, " valid"], camera: Camera, depth_range: tuple[float, float] | None) -> None:
    """Check that the measured depths can be in the units of the camera's range and of the box.

    **Raises:** `ValueError` if all depths are nearer or all are farther than the camera's range, or if more than 99.9 %
    of the depths in the range differ from the box's by a factor above 20. A smaller share may be background or glare.
    """
    if not len(depth):
        return
    farthest = np.inf if camera.farthest is None else camera.farthest
    require(
        depth.max() >= camera.nearest and depth.min() <= farthest,
        f"all depths, from {depth.min():.4g} to {depth.max():.4g}, are out of the camera's range of "
        f"{camera.nearest:.4g} to {farthest:.4g}: give the depth's scale, 0.001 for millimetres and a pose in metres, "
        "or another range",
    )
    depth = depth[(depth >= camera.nearest) & (depth <= farthest)]
    if depth_range is None or not len(depth):
        return
    near, far = depth_range
    require(
        bool(((depth > near / _MAX_DEPTH_RATIO) & (depth < _MAX_DEPTH_RATIO * far)).mean() >= _MIN_FRACTION),
        f"the depths have a median of {np.median(depth):.4g}, but the box is {near:.4g} to {far:.4g} away: give the "
        "depth's scale, 0.001 for millimetres and a pose in metres",
    )


def _warn_of_nothing_inside(points: Float[np.ndarray, "valid 3"], inside: Bool[np.ndarray, " n"], box: Box) -> None:
    """Warn if no point lies in the box. Most often the pose is wrong, or the object is out of view."""
    if len(points) and not inside.any():
        low, high = points.min(axis=0), points.max(axis=0)
        warnings.warn(
            f"none of the {len(points)} points of the depth image lies in the box {box}: they "
            f"lie from {low} to {high}. Is the pose from camera to world, in the right convention, and the box in its "
            "units?",
            NothingInside,
            stacklevel=4,
        )
