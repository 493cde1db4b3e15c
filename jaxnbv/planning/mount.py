"""Pose errors estimated from a session's images, and the corrected poses."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.alignment import Alignment, align_views, errors_of
from jaxnbv.planning.images import Image, stride_of
from jaxnbv.planning.session_warnings import warn_of_mount

# Planning uses some rows and columns of an image. Images are compared at every third of these rows and columns.
_STRIDE = 3
# Smallest number of views for a correction or warning. Two views may disagree by chance.
_MIN_VIEWS = 3
# New corrections are ignored if they move points by at most this fraction of the points' noise.
_MIN_CHANGE = 0.5


class MountError:
    """Errors of a session's poses, such as an error of the camera's mount on the robot's hand.

    They are estimated by aligning the images. The session decides whether to use the corrections.

    - `camera`, `convention`: as in the session.
    - `corrections`: (views, 4, 4), the correction X of each image. The true pose of the camera is `matrix @ X`, in
      OpenCV's axes.
    """

    def __init__(self, camera: Camera, convention: str):
        self.camera, self.convention = camera, convention
        self.corrections: Float[np.ndarray, "views 4 4"] = np.zeros((0, 4, 4))
        self._images: list[Image] = []
        self._clouds: list[PointCloud] = []
        self._alignment: Alignment | None = None
        self._has_warned = False

    def add(self, image: Image, index: int) -> None:
        """Add the image with this index, unless it was added before.

        - `image`: a result of `Image.without_sentinels`.
        """
        if index == len(self._images):
            self._images.append(image)

    def alignment(self) -> Alignment:
        """Return the alignment of the images, from all measured points inside and outside the box.

        **Raises:** `ValueError` for fewer than two images.
        """
        if self._alignment is None or len(self._alignment.corrections) != len(self._images):
            poses = [Pose.from_matrix(image.matrix, self.convention) for image in self._images]
            stride = stride_of(self.camera)
            strided = self.camera.strided(stride)
            coarse = np.zeros((strided.height, strided.width), bool)
            coarse[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE] = True
            for image, pose in list(zip(self._images, poses, strict=True))[len(self._clouds) :]:
                self._clouds.append(image.cloud(self.camera, pose, stride).only(jnp.asarray(coarse.reshape(-1))))
            self._alignment = align_views(self._clouds, poses)
        return self._alignment

    def warn_if_misaligned(self) -> None:
        """Warn once if three or more images disagree."""
        if not self._has_warned and len(self._images) >= _MIN_VIEWS and (alignment := self.alignment()).disagrees:
            self._has_warned = True
            warn_of_mount(alignment)

    @property
    def mount(self) -> Float[np.ndarray, "4 4"]:
        """Correction X that all views share; the identity if the views have different corrections or none."""
        first = self.corrections[0] if len(self.corrections) else np.eye(4)
        return first if bool(np.all(self.corrections == first)) else np.eye(4)

    def pose(self, image: Image, index: int) -> Pose:
        """Return the corrected world pose of an image. An image without its own correction gets `mount`."""
        pose = Pose.from_matrix(image.matrix, self.convention)
        correction = self.corrections[index] if index < len(self.corrections) else self.mount
        if np.array_equal(correction, np.eye(4)):
            return pose
        return Pose.from_matrix(np.asarray(pose.to_matrix(), np.float64) @ correction)

    def command_poses(self, poses: Pose) -> Pose:
        """Return the poses to command so that the camera arrives at `poses` (n,) despite the mount's error."""
        if np.array_equal(self.mount, np.eye(4)):
            return poses
        return Pose.from_matrix(np.asarray(poses.to_matrix(), np.float64) @ np.linalg.inv(self.mount))

    def update(self) -> bool:
        """Update the corrections, and return whether they changed noticeably."""
        if len(self._images) < _MIN_VIEWS:
            return False
        alignment = self.alignment()
        current = np.tile(self.mount, (len(self._images), 1, 1))
        current[: len(self.corrections)] = self.corrections
        angles, shifts = errors_of(np.linalg.inv(current) @ alignment.corrections)
        is_changed = bool(np.max(alignment.distance * angles + shifts) > _MIN_CHANGE * alignment.noise)
        self.corrections = alignment.corrections if is_changed else current
        return is_changed
