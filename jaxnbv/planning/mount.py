"""The error of the poses of a session: what its images tell, and where the cameras truly were."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.alignment import Alignment, align_views, errors_of
from jaxnbv.planning.images import Image, stride_of
from jaxnbv.planning.session_warnings import warn_of_mount

# Images are compared by every so many-th of the rows and columns that are planned with.
_COARSER = 3
# Two views may disagree by chance.
_ENOUGH = 3
# Corrections that move points by less than this share of the noise are equal.
_EQUAL = 0.5


class MountError:
    """How far the images of a session disagree, and the corrections of their poses that are used.

    - `camera`: the sensor; `convention`: of the images' matrices, see `Pose.from_matrix`.
    - `corrections`: (views, 4, 4), X of each image: its camera was at `matrix @ X`, in OpenCV's axes.
    """

    def __init__(self, camera: Camera, convention: str):
        self.camera, self.convention = camera, convention
        self.corrections: Float[np.ndarray, "views 4 4"] = np.zeros((0, 4, 4))
        self._images: list[Image] = []
        self._clouds: list[PointCloud] = []
        self._alignment: Alignment | None = None

    def show(self, image: Image, index: int) -> None:
        """An image of this number, without values that stand for "not measured"; it may be shown again."""
        if index == len(self._images):
            self._images.append(image)

    def alignment(self) -> Alignment:
        """Of the images, with all that stands around the object.

        **Raises:** `ValueError` for fewer than two images.
        """
        if self._alignment is None or len(self._alignment.corrections) != len(self._images):
            poses = [Pose.from_matrix(image.matrix, self.convention) for image in self._images]
            stride = stride_of(self.camera)
            strided = self.camera.strided(stride)
            kept = np.zeros((strided.height, strided.width), bool)
            kept[_COARSER // 2 :: _COARSER, _COARSER // 2 :: _COARSER] = True
            for image, pose in list(zip(self._images, poses, strict=True))[len(self._clouds) :]:
                self._clouds.append(image.cloud(self.camera, pose, stride).only(jnp.asarray(kept.reshape(-1))))
            self._alignment = align_views(self._clouds, poses)
        return self._alignment

    def warns(self) -> bool:
        """Warn if the images disagree; whether they do."""
        if len(self._images) < _ENOUGH or not (alignment := self.alignment()).disagrees:
            return False
        warn_of_mount(alignment)
        return True

    @property
    def mount(self) -> Float[np.ndarray, "4 4"]:
        """X of the mount; the identity where each view has its own, or none has any."""
        first = self.corrections[0] if len(self.corrections) else np.eye(4)
        return first if bool(np.all(self.corrections == first)) else np.eye(4)

    def pose(self, image: Image, index: int) -> Pose:
        """Where the camera of an image was, as far as the images so far tell."""
        pose = Pose.from_matrix(image.matrix, self.convention)
        correction = self.corrections[index] if index < len(self.corrections) else self.mount
        if np.array_equal(correction, np.eye(4)):
            return pose
        return Pose.from_matrix(np.asarray(pose.to_matrix(), np.float64) @ correction)

    def sent(self, poses: Pose) -> Pose:
        """Where to send the camera, so that it comes to stand at poses (n,)."""
        if np.array_equal(self.mount, np.eye(4)):
            return poses
        return Pose.from_matrix(np.asarray(poses.to_matrix(), np.float64) @ np.linalg.inv(self.mount))

    def update(self) -> bool:
        """Use what the images tell now; whether that moves a camera."""
        if len(self._images) < _ENOUGH:
            return False
        alignment = self.alignment()
        used = np.tile(self.mount, (len(self._images), 1, 1))
        used[: len(self.corrections)] = self.corrections
        turns, shifts = errors_of(np.linalg.inv(used) @ alignment.corrections)
        moves = bool(np.max(alignment.distance * turns + shifts) > _EQUAL * alignment.noise)
        self.corrections = alignment.corrections if moves else used
        return moves
