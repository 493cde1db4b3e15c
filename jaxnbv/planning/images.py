"""Depth images with their poses, as the user adds them to a session."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Real

from jaxnbv.checks import AnyArray, as_numbers, require, short_text
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.depth_image import without_sentinels
from jaxnbv.geometry.distortion import pixels_of, undistort_points
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box

Ignore: TypeAlias = Callable[[Float[np.ndarray, "n 3"]], Any]
"""Function of world points (n, 3) that returns, for each point, whether it belongs to the robot, as a bool."""

# Largest number of rays of an image that are used. A cloud holds a few thousand points, so more rays only cost time.
_MAX_RAYS = 20_000
# Pose matrices count as equal if their entries differ by at most this, because some may have been stored in 32 bits.
_MATRIX_TOLERANCE = 1e-5


class Image(NamedTuple):
    """A depth image as the user added it.

    - `depth`: depth image in the user's unit.
    - `matrix`: camera-to-world matrix.
    - `scale`: factor from `depth` to world units.
    - `mask`: mask of the pixels that show the object; None if every pixel may show it.
    - `robot`: mask of the pixels that show the robot; None if no pixel is known to show it.
    """

    depth: Real[np.ndarray, "height width"]
    matrix: Float[np.ndarray, "4 4"]
    scale: float
    mask: Bool[np.ndarray, "height width"] | None
    robot: Bool[np.ndarray, "height width"] | None = None

    @classmethod
    def from_arrays(cls, depth: AnyArray, matrix: AnyArray | list, scale: float, mask: AnyArray | None) -> "Image":
        """Check the user's arguments and convert them to an image.

        **Raises:** `ValueError` for a depth image or matrix that is not numeric, or a mask that is not a boolean array
        of the image's shape.
        """
        pixels = as_numbers(depth, "the depth image", None)
        pixel_mask = None if mask is None else np.asarray(mask)
        if pixel_mask is not None:
            is_valid = pixel_mask.dtype == bool and pixel_mask.shape == pixels.shape
            require(
                is_valid, f"the mask is {short_text(mask)}: give a boolean array of the image's shape, {pixels.shape}"
            )
        # The pixels are copied, because a driver may write its next image into the same memory.
        return cls(pixels.copy(), as_numbers(matrix, "the matrix of a pose", np.float64), scale, pixel_mask)

    def without_sentinels(self, camera: Camera, pose: Pose, box: Box) -> "Image":
        """Return a copy in which depths that mean "not measured" are zero, see `jaxnbv.geometry.depth_image`."""
        return self._replace(depth=without_sentinels(self.depth, camera, pose, self.scale, box))

    @property
    def world_depth(self) -> Float[np.ndarray, "height width"]:
        """The depth image in world units, with zeros for values that are not finite."""
        return np.where(np.isfinite(self.depth), self.scale * np.asarray(self.depth, np.float64), 0.0)

    def points(self, camera: Camera, pose: Pose) -> Float[np.ndarray, "height width 3"]:
        """Return the world point of each pixel, or the camera's position for a pixel without a measurement."""
        depth = self.world_depth
        rays = np.asarray(camera.pixel_directions(), np.float64).reshape(*depth.shape, 3)
        if camera.distortion:
            rays = np.stack([*undistort_points(rays[..., 0], rays[..., 1], camera.distortion), rays[..., 2]], axis=-1)
        local = depth[..., None] * rays
        return local @ np.asarray(pose.rotation, np.float64).T + np.asarray(pose.position, np.float64)

    def with_robot(self, ignore: Ignore, camera: Camera, pose: Pose) -> "Image":
        """Return a copy with a mask of the robot's pixels.

        - `ignore`: function of the measured world points that returns, for each point, whether it belongs to the robot.

        **Raises:** `ValueError` if `ignore` does not return a bool for each point.
        """
        is_measured = np.isfinite(self.depth) & (self.depth > 0)
        is_robot = np.asarray(ignore(self.points(camera, pose)[is_measured]))
        require(
            is_robot.shape == (int(is_measured.sum()),) and is_robot.dtype == bool,
            f"ignore returned {short_text(is_robot)} for {int(is_measured.sum())} points: return a bool for each",
        )
        robot = np.zeros(self.depth.shape, bool)
        robot[is_measured] = is_robot
        return self._replace(robot=robot)

    def cloud(self, camera: Camera, pose: Pose, stride: int, box: Box | None = None) -> PointCloud:
        """Return the image's cloud without the points at `robot` pixels. The object's `mask` is not applied."""
        cloud = PointCloud.from_depth(self.depth, camera, pose, self.scale, stride, box)
        return cloud if self.robot is None else only_where(cloud, ~self.robot, camera, stride)

    def is_blank(self, cloud: PointCloud) -> bool:
        """Return whether the image has no measurement.

        True if `cloud` (the points in the box) is empty, and either all its rays are invalid or all positive pixels
        have the same finite value, which then means "not measured".
        """
        if bool(cloud.mask.any()):
            return False
        values = np.unique(self.depth[self.depth > 0])
        return not bool(np.any(cloud.missed)) or (len(values) == 1 and bool(np.isfinite(values[0])))

    def check_not_stale(self, earlier: "tuple[Image, ...]") -> None:
        """Raise `ValueError` if one of the `earlier` images has the same depths but a different pose.

        In that case the driver returned a frame from before the move. An image without a positive depth is not checked.
        """
        if not (self.depth > 0).any():
            return
        for number, image in enumerate(earlier, start=1):
            is_same = np.array_equal(image.depth, self.depth, equal_nan=self.depth.dtype.kind == "f")
            require(
                not is_same or bool(np.abs(image.matrix - self.matrix).max() <= _MATRIX_TOLERANCE),
                f"the image is bit for bit equal to image {number}, which has a different pose, so the driver returned "
                "an old frame. Discard the frames that the driver still holds after a move",
            )


def only_where(cloud: PointCloud, pixels: Bool[np.ndarray, "height width"], camera: Camera, stride: int) -> PointCloud:
    """Return an image's cloud with only the points of some pixels. Its `sight` and `missed` do not change.

    - `pixels`: mask of the pixels whose points are kept, at full resolution.
    - `stride`: stride of the image's rows and columns from which the cloud was made.
    """
    if camera.distortion:
        # The rays of a cloud belong to a camera without distortion, so the mask must be resampled.
        coordinates = np.asarray(camera.pixel_directions(), np.float64).reshape(*pixels.shape, 3)[..., :2]
        column, row = pixels_of(coordinates, camera.intrinsics, camera.distortion)
        columns = np.clip(np.round(column).astype(int), 0, camera.width - 1)
        pixels = pixels[np.clip(np.round(row).astype(int), 0, camera.height - 1), columns]
    rows = slice(stride // 2, None, stride)
    return cloud.only(jnp.asarray(pixels[rows, rows].reshape(-1)))


def stride_of(camera: Camera) -> int:
    """Return the stride of rows and columns that leaves at most about `_MAX_RAYS` rays of an image."""
    return math.ceil(math.sqrt(camera.num_rays / _MAX_RAYS))
