"""A depth image with where it was taken, as a session gets it."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Real

from jaxnbv.checks import AnyArray, as_numbers, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.depth_image import without_sentinels
from jaxnbv.geometry.distortion import pixels_of, straightened
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box

Ignore: TypeAlias = Callable[[Float[np.ndarray, "n 3"]], Any]
"""A function of points in the world: which of them are of the robot, say, and are left out."""

# A cloud holds some thousands of points; more rays than these only take time.
_MOST_RAYS = 20_000
# Entries of two matrices of one pose differ by less, as stored in 32 bits.
_SAME_PLACE = 1e-5


class Image(NamedTuple):
    """A depth image as it was given.

    - `depth`: `scale` times it is in world units; `matrix`: where the camera is said to have been.
    - `mask`: pixels that show the object, None for all.
    - `robot`: pixels that show the robot itself, None for none.
    """

    depth: Real[np.ndarray, "height width"]
    matrix: Float[np.ndarray, "4 4"]
    scale: float
    mask: Bool[np.ndarray, "height width"] | None
    robot: Bool[np.ndarray, "height width"] | None = None

    @classmethod
    def of(cls, depth: AnyArray, matrix: AnyArray | list, scale: float, mask: AnyArray | None) -> "Image":
        """**Raises:** `ValueError` for what is no image, no matrix, or no mask of the image's shape."""
        pixels = as_numbers(depth, "the depth image", None)
        shows = None if mask is None else np.asarray(mask)
        if shows is not None:
            proper = shows.dtype == bool and shows.shape == pixels.shape
            require(
                proper, f"the mask is {shown(mask)}: give truths, one for each of the image's {pixels.shape} pixels"
            )
        # A driver may write its next image into the same memory.
        return cls(pixels.copy(), as_numbers(matrix, "the matrix of a pose", np.float64), scale, shows)

    def cleaned(self, camera: Camera, pose: Pose, box: Box) -> "Image":
        """The image with zeros where its value stands for "not measured", see `without_sentinels`."""
        return self._replace(depth=without_sentinels(self.depth, camera, pose, self.scale, box))

    def points(self, camera: Camera, pose: Pose) -> Float[np.ndarray, "height width 3"]:
        """The point of each pixel, in world units; the camera where nothing was met."""
        depth = np.where(np.isfinite(self.depth), self.scale * np.asarray(self.depth, np.float64), 0.0)
        ahead = np.asarray(camera.pixel_directions(), np.float64).reshape(*depth.shape, 3)
        if camera.distortion:
            ahead = np.stack([*straightened(ahead[..., 0], ahead[..., 1], camera.distortion), ahead[..., 2]], axis=-1)
        local = depth[..., None] * ahead
        return local @ np.asarray(pose.rotation, np.float64).T + np.asarray(pose.position, np.float64)

    def with_robot(self, ignore: Ignore, camera: Camera, pose: Pose) -> "Image":
        """The image with the pixels whose points a function says to be of the robot.

        **Raises:** `ValueError` if it does not say a truth of each point.
        """
        measured = np.isfinite(self.depth) & (self.depth > 0)
        said = np.asarray(ignore(self.points(camera, pose)[measured]))
        require(
            said.shape == (int(measured.sum()),) and said.dtype == bool,
            f"ignore says {shown(said)} of {int(measured.sum())} points: give a truth for each",
        )
        robot = np.zeros(self.depth.shape, bool)
        robot[measured] = said
        return self._replace(robot=robot)

    def cloud(self, camera: Camera, pose: Pose, stride: int, box: Box | None = None) -> PointCloud:
        """What it shows but for the robot, see `PointCloud.from_depth`; the mask is not applied."""
        cloud = PointCloud.from_depth(self.depth, camera, pose, self.scale, stride, box)
        return cloud if self.robot is None else only_where(cloud, ~self.robot, camera, stride)

    def is_blank(self, cloud: PointCloud) -> bool:
        """Whether it measured nothing: no pixel is valid, or all of them have one value and show no surface."""
        if bool(cloud.mask.any()):
            return False
        values = np.unique(self.depth[self.depth > 0])
        return not bool(np.any(cloud.missed)) or (len(values) == 1 and bool(np.isfinite(values[0])))

    def check_moved(self, earlier: "tuple[Image, ...]") -> None:
        """**Raises:** `ValueError` if an earlier image is the same though its pose is another, and it measured
        something."""
        if not (self.depth > 0).any():
            return
        for number, image in enumerate(earlier, start=1):
            is_same = np.array_equal(image.depth, self.depth, equal_nan=self.depth.dtype.kind == "f")
            require(
                not is_same or bool(np.abs(image.matrix - self.matrix).max() <= _SAME_PLACE),
                f"the image is bit for bit image {number}, which was taken from another pose: it is of an earlier "
                "moment than its pose. Discard the frames that the driver still holds after a move",
            )


def only_where(cloud: PointCloud, pixels: Bool[np.ndarray, "height width"], camera: Camera, stride: int) -> PointCloud:
    """The points of some pixels of the image that a cloud was taken from; the rays of the others end where they did."""
    if camera.distortion:
        # The rows of a cloud are pixels of the pinhole.
        place = np.asarray(camera.pixel_directions(), np.float64).reshape(*pixels.shape, 3)[..., :2]
        column, row = pixels_of(place, camera.intrinsics, camera.distortion)
        across = np.clip(np.round(column).astype(int), 0, camera.width - 1)
        pixels = pixels[np.clip(np.round(row).astype(int), 0, camera.height - 1), across]
    rows = slice(stride // 2, None, stride)
    return cloud.only(jnp.asarray(pixels[rows, rows].reshape(-1)))


def stride_of(camera: Camera) -> int:
    """The stride that leaves as many rays of an image as are worth their time."""
    return math.ceil(math.sqrt(camera.num_rays / _MOST_RAYS))
