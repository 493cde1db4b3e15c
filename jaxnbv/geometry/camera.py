"""A pinhole depth camera: its pixels, its rays, and the limits of what it measures.

In the camera's frame, x points right, y down and z forward (OpenCV's convention).
"""

import dataclasses
import math
import warnings
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray, as_numbers, check_fields, checked, is_traced, require
from jaxnbv.geometry.distortion import check_distortion
from jaxnbv.geometry.pose import Pose
from jaxnbv.programs import program

_Points = TypeVar("_Points", Float[Array, "*n 2"], Float[np.ndarray, "*n 2"])
# Skew below this fraction of fx counts as zero.
_MAX_SKEW = 1e-6
# `_MAX_TANGENT`: no ray of a depth camera is more than 70 degrees off the axis. `_MAX_CENTER_OFFSET`: a principal point
# counts as the centre of an image if it is off by at most this fraction of half the width and of half the height.
_MAX_TANGENT, _MAX_CENTER_OFFSET = math.tan(math.radians(70.0)), 0.2
# A principal point at this fraction or more of both the width and the height certainly belongs to a larger image.
_MAX_CENTER_FRACTION = 0.96


def _limit(depth: Any) -> Any:
    """Convert a limit of the camera's range to an array, so that one compiled program runs for any limit.

    If there is no limit, the value stays 0.0 or None, so that programs can branch on it.
    """
    is_number = isinstance(depth, int | float) and not isinstance(depth, bool) and depth != 0
    return np.float64(depth) if is_number else depth


class Camera(eqx.Module):
    """A pinhole depth camera. The centres of pixels are at 0.5, 1.5, ... from the image's top left corner.

    - `fov`: vertical field of view 2 atan(height / (2 fy)), in radians within (0, pi), for a focal length of fy pixels.
    - `height`, `width`: number of rows and columns of pixels. One ray goes through the centre of each pixel.
    - `aspect`: horizontal focal length divided by vertical focal length, both in pixels; 1 for square pixels.
    - `center`: the principal point, as fractions of the width and the height.
    - `nearest`, `farthest`: least and greatest depth that the sensor measures, along the viewing direction, in scene
      units. `nearest=0` and `farthest=None` mean no limit. A hit nearer than `nearest` is invalid. A ray without a hit
      up to `farthest` counts as a miss: the space along it is empty up to `farthest`.
    - `max_incidence`: largest angle between a ray and the normal of a measured hit, in radians within (0, pi/2].
    - `distortion`: lens coefficients, see `from_intrinsics`. Rays ignore them; `PointCloud.from_depth` undoes them.

    The defaults are the paper's: 30 degrees, 50 x 50 pixels, no limits.

    **Raises:** `ValueError` for a value outside these limits.
    """

    fov: float = eqx.field(static=True, default=math.radians(30.0))
    height: int = eqx.field(static=True, default=50)
    width: int = eqx.field(static=True, default=50)
    aspect: float = eqx.field(static=True, default=1.0)
    center: tuple[float, float] = eqx.field(static=True, default=(0.5, 0.5))
    nearest: float = eqx.field(converter=_limit, default=0.0)
    farthest: float | None = eqx.field(converter=_limit, default=None)
    max_incidence: float = eqx.field(static=True, default=0.5 * math.pi)
    distortion: tuple[float, ...] = eqx.field(static=True, default=())

    def __check_init__(self):
        check_fields(self)
        require(0 < self.fov < math.pi, f"the field of view is {self.fov} rad; it must lie within (0, pi)")
        for side in (self.height, self.width):
            require(side >= 1, f"the camera has {self.height} x {self.width} pixels; it needs at least one")
        require(self.aspect > 0, f"the aspect of the pixels is {self.aspect}; it must be positive")
        require(
            is_traced(self.nearest, self.farthest)
            or 0 <= self.nearest < (math.inf if self.farthest is None else self.farthest),
            f"the camera measures from {self.nearest} to {self.farthest}: give 0 <= nearest < farthest",
        )
        require(
            0 < self.max_incidence <= 0.5 * math.pi,
            f"the largest angle of incidence is {self.max_incidence} rad; it must lie within (0, pi/2]",
        )
        if self.distortion != ():
            left, top, right, bottom = map(abs, self.edges)
            check_distortion(self.distortion, math.hypot(max(left, right), max(top, bottom)))

    @classmethod
    @checked
    def from_intrinsics(
        cls,
        matrix: Float[AnyArray, "3 3"] | list,
        height: int,
        width: int,
        nearest: float = 0.0,
        farthest: float | None = None,
        max_incidence: float = 0.5 * math.pi,
        distortion: Float[AnyArray, " k"] | list | tuple = (),
    ) -> "Camera":
        """Build a camera from an intrinsic matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels.

        The centre of the first pixel is at (0, 0), as in OpenCV and the calibrations of camera makers. The principal
        point may lie outside the image, since the image may be a window of a larger image. Warns if the matrix is
        probably for another image size than `height` x `width`.

        - `distortion`: OpenCV's coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]]. For the other arguments, see `Camera`.

        **Raises:** `ValueError` for a matrix of another form (for example with skew), a matrix that is certainly for
        another image size, a wrong number of coefficients, or coefficients that map two points to the same pixel.
        """
        intrinsics = as_numbers(matrix, "the intrinsic matrix", np.float64)
        require(intrinsics.shape == (3, 3), f"the intrinsic matrix has shape {intrinsics.shape}: give one of (3, 3)")
        (fx, skew, cx), (zero, fy, cy), last = intrinsics.tolist()
        require(
            0 < fx < math.inf and 0 < fy < math.inf and last == [0.0, 0.0, 1.0] and zero == 0.0,
            f"the intrinsic matrix is {intrinsics.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with "
            "positive focal lengths, in pixels",
        )
        require(
            fy > 0.01 * height,
            f"the intrinsic matrix has a focal length of {fy:.4g} for {height} rows: give the matrix in pixels, not "
            "its inverse",
        )
        require(abs(skew) <= _MAX_SKEW * fx, f"the intrinsic matrix has a skew of {skew}: undistort the image first")
        fov = 2.0 * math.atan(0.5 * height / fy)
        center = ((cx + 0.5) / width, (cy + 0.5) / height)
        _check_image_size(intrinsics, height, width, center)
        coefficients = tuple(as_numbers(distortion, "the distortion", np.float64).reshape(-1).tolist())
        return cls(fov, height, width, fx / fy, center, nearest, farthest, max_incidence, coefficients)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsic matrix in pixels. The centre of the first pixel is at (0, 0)."""
        (fx, fy), (x, y) = self.focal_lengths, self.center
        return np.array([[fx, 0.0, x * self.width - 0.5], [0.0, fy, y * self.height - 0.5], [0.0, 0.0, 1.0]])

    @checked
    def resized(self, height: int, width: int) -> "Camera":
        """Return a camera with the same field of view and a different number of pixels."""
        aspect = self.aspect * (width / self.width) / (height / self.height)
        return dataclasses.replace(self, height=height, width=width, aspect=aspect)

    @checked
    def strided(self, stride: int) -> "Camera":
        """Return the camera whose image has every `stride`-th row and column, starting at `stride // 2`.

        **Raises:** `ValueError` for a stride that is below one or leaves no pixel.
        """
        require(stride >= 1, f"the stride is {stride}; it must be at least 1")
        start = stride // 2
        height, width = (-(-(side - start) // stride) for side in (self.height, self.width))
        require(height >= 1 and width >= 1, f"a stride of {stride} leaves none of {self.height} x {self.width} pixels")
        matrix = self.intrinsics
        matrix[:2] /= stride
        matrix[:2, 2] -= start / stride
        fov, center = 2.0 * math.atan(0.5 * height / matrix[1, 1]), matrix[:2, 2] + 0.5
        fractions = float(center[0] / width), float(center[1] / height)
        return dataclasses.replace(self, fov=fov, height=height, width=width, center=fractions)

    @property
    def num_rays(self) -> int:
        """Number of rays, one for each pixel."""
        return self.height * self.width

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Horizontal and vertical focal length, in pixels."""
        vertical = 0.5 * self.height / math.tan(0.5 * self.fov)
        return self.aspect * vertical, vertical

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Coordinates of the image's left, top, right and bottom edge in the camera's plane z = 1."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.center
        return -cx * self.width / fx, -cy * self.height / fy, (1 - cx) * self.width / fx, (1 - cy) * self.height / fy

    @property
    def limited(self) -> bool:
        """Whether the sensor has a limited range or a limited angle of incidence."""
        has_range = is_traced(self.nearest) or bool(self.nearest > 0) or self.farthest is not None
        return has_range or self.max_incidence < 0.5 * math.pi

    def pixel_directions(self) -> Float[Array, "rays 3"]:
        """Return the directions through the pixel centres in the camera's frame, with z = 1, row by row."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.center
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        x = (column - cx * self.width) / fx
        y = (row - cy * self.height) / fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        return jnp.asarray(directions, dtype=jnp.result_type(float))

    def to_pixels(self, plane_points: _Points) -> _Points:
        """Convert points (x, y) of the plane z = 1 to (column, row). The first pixel's centre is (0.5, 0.5)."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.center
        scale, offset = np.array([[fx, fy], [cx * self.width, cy * self.height]], plane_points.dtype)
        return plane_points * scale + offset

    @program
    def rays(self, pose: Pose) -> tuple[Float[Array, "*batch rays 3"], Float[Array, "*batch rays 3"]]:
        """Return the origins and unit directions of all rays in scene coordinates, for one pose or a batch."""
        directions = self.pixel_directions()
        directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
        directions = jnp.einsum("...ij,rj->...ri", pose.rotation, directions, precision="highest")
        return jnp.broadcast_to(pose.position[..., None, :], directions.shape), directions


def _check_image_size(matrix: np.ndarray, height: int, width: int, center: tuple[float, float]) -> None:
    """Warn if the principal point suggests that an intrinsic matrix is for an image of another size.

    - `center`: the principal point, as fractions of the width and the height.

    **Raises:** `ValueError` instead of the warning if the principal point is near the image's lower right corner or
    beyond. Also raises it if the principal point is outside the image and a pixel is over 70 degrees off the axis.
    """
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    tangent_x, tangent_y = (
        max(x, 1.0 - x) * side / f for x, side, f in zip(center, (width, height), (fx, fy), strict=True)
    )
    require(
        all(0 <= fraction <= 1 for fraction in center) or max(tangent_x, tangent_y) < _MAX_TANGENT,
        f"the principal point ({cx}, {cy}) lies outside the image of {width} x {height}, which would end "
        f"{math.degrees(math.atan(max(tangent_x, tangent_y))):.0f} degrees off the axis: give the matrix for this "
        "image size",
    )
    for ratio in (0.5, 2.0, 3.0, 4.0):
        if not all(abs(2.0 * fraction / ratio - 1.0) <= _MAX_CENTER_OFFSET for fraction in center):
            continue
        problem = (
            f"the principal point ({cx:.5g}, {cy:.5g}) is the centre of an image of {2 * cx + 1:.0f} x "
            f"{2 * cy + 1:.0f}, but this one is {width} x {height}. If it was binned, decimated or resized, the matrix "
            f"is for the other size: divide its first two rows by {ratio:g}. If it is a window of a larger image"
        )
        require(min(center) < _MAX_CENTER_FRACTION, f"{problem}, use Camera(fov, height, width, aspect, center)")
        warnings.warn(f"{problem}, ignore this warning", stacklevel=4)
