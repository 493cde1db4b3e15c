"""The sensor: a pinhole depth camera, its rays, and what it measures.

OpenCV convention: in the camera's own frame x points right, y down and z forward, along the view.
"""

import dataclasses
import math
from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray, as_numbers, check_fields, checked, require
from jaxnbv.geometry.pose import Pose

_Places = TypeVar("_Places", Float[Array, "*n 2"], Float[np.ndarray, "*n 2"])
# Of the focal length: what a calibration without skew is written down to.
_SKEW = 1e-6


class Camera(eqx.Module):
    """A pinhole depth camera. Pixels are counted from the image's top left corner: their centres are at 0.5, 1.5, ...

    - `fov`: vertical field of view in radians, within (0, pi), as if the principal point were at the image's centre.
    - `height`, `width`: pixels; one ray through the centre of each.
    - `aspect`: focal length across over focal length down, in pixels; 1 for square pixels.
    - `center`: the principal point, as shares of the width and the height.
    - `nearest`, `farthest`: depths along the viewing direction between which the sensor measures, in scene units; None
      is no limit. A hit before `nearest` is invalid; a ray without a hit before `farthest` met nothing up to there.
    - `max_incidence`: largest angle in radians, within (0, pi/2], between a ray and the normal at which a hit returns.

    The defaults are the paper's: 30 degrees, 50 x 50, no limits.

    **Raises:** `ValueError` for a value outside what is said here.
    """

    fov: float = eqx.field(static=True, default=math.radians(30.0))
    height: int = eqx.field(static=True, default=50)
    width: int = eqx.field(static=True, default=50)
    aspect: float = eqx.field(static=True, default=1.0)
    center: tuple[float, float] = eqx.field(static=True, default=(0.5, 0.5))
    nearest: float = eqx.field(static=True, default=0.0)
    farthest: float | None = eqx.field(static=True, default=None)
    max_incidence: float = eqx.field(static=True, default=0.5 * math.pi)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.fov < math.pi, f"the field of view is {self.fov} rad; it must lie within (0, pi)")
        for side in (self.height, self.width):
            require(side >= 1, f"the camera has {self.height} x {self.width} pixels; it needs at least one")
        require(self.aspect > 0, f"the aspect of the pixels is {self.aspect}; it must be positive")
        require(
            0 <= self.nearest < (math.inf if self.farthest is None else self.farthest),
            f"the camera measures from {self.nearest} to {self.farthest}: give depths of which the second is greater",
        )
        require(
            0 < self.max_incidence <= 0.5 * math.pi,
            f"the largest angle of incidence is {self.max_incidence} rad; it must lie within (0, pi/2]",
        )

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
    ) -> "Camera":
        """The camera of an intrinsic matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, as OpenCV and the makers
        of depth cameras give it: the centre of the first pixel is at (0, 0). The limits are those of the camera.

        **Raises:** `ValueError` for another matrix, such as one with skew or of another image size.
        """
        found = as_numbers(matrix, "the intrinsic matrix", np.float64)
        require(found.shape == (3, 3), f"the intrinsic matrix has shape {found.shape}: give one of (3, 3)")
        (fx, skew, cx), (zero, fy, cy), last = found.tolist()
        require(
            0 < fx < math.inf and 0 < fy < math.inf and last == [0.0, 0.0, 1.0] and zero == 0.0,
            f"the intrinsic matrix is {found.tolist()}; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive "
            "focal lengths, in pixels",
        )
        require(
            fy > 0.01 * height,
            f"the intrinsic matrix has a focal length of {fy:.4g} for {height} rows: give it in pixels, and no inverse",
        )
        require(abs(skew) <= _SKEW * fx, f"the intrinsic matrix has a skew of {skew}: undistort the image first")
        require(
            -0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5,
            f"the principal point ({cx}, {cy}) lies outside the image of {width} x {height}: give the matrix that is "
            "of this image size",
        )
        fov = 2.0 * math.atan(0.5 * height / fy)
        center = ((cx + 0.5) / width, (cy + 0.5) / height)
        return cls(fov, height, width, fx / fy, center, nearest, farthest, max_incidence)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsic matrix of `from_intrinsics`, in pixels."""
        (fx, fy), (x, y) = self.focal_lengths, self.center
        return np.array([[fx, 0.0, x * self.width - 0.5], [0.0, fy, y * self.height - 0.5], [0.0, 0.0, 1.0]])

    @checked
    def resized(self, height: int, width: int) -> "Camera":
        """The camera of the same field of view with another number of pixels, to imagine with fewer rays, say."""
        aspect = self.aspect * (width / self.width) / (height / self.height)
        return dataclasses.replace(self, height=height, width=width, aspect=aspect)

    @checked
    def strided(self, stride: int) -> "Camera":
        """The camera of every so many-th row and column, the first ones half as far from the border.

        **Raises:** `ValueError` for a stride below one, or one that leaves no pixel.
        """
        require(stride >= 1, f"the stride is {stride}; it must be at least 1")
        first = stride // 2
        height, width = (-(-(side - first) // stride) for side in (self.height, self.width))
        require(height >= 1 and width >= 1, f"a stride of {stride} leaves none of {self.height} x {self.width} pixels")
        matrix = self.intrinsics
        matrix[:2] /= stride
        matrix[:2, 2] -= first / stride
        fov, center = 2.0 * math.atan(0.5 * height / matrix[1, 1]), matrix[:2, 2] + 0.5
        share = float(center[0] / width), float(center[1] / height)
        return dataclasses.replace(self, fov=fov, height=height, width=width, center=share)

    @property
    def num_rays(self) -> int:
        return self.height * self.width

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths across and down, in pixels."""
        down = 0.5 * self.height / math.tan(0.5 * self.fov)
        return self.aspect * down, down

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Where the image ends to the left, above, to the right and below, in the plane z = 1 of the camera's frame."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.center
        return -cx * self.width / fx, -cy * self.height / fy, (1 - cx) * self.width / fx, (1 - cy) * self.height / fy

    @property
    def limited(self) -> bool:
        """Whether the sensor has a range, or an angle beyond which hits do not return."""
        return self.nearest > 0 or self.farthest is not None or self.max_incidence < 0.5 * math.pi

    def pixel_directions(self) -> Float[Array, "rays 3"]:
        """Directions through the pixel centres in the camera's frame, scaled so that z = 1; row by row."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.center
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        x = (column - cx * self.width) / fx
        y = (row - cy * self.height) / fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        return jnp.asarray(directions, dtype=jnp.result_type(float))

    def to_pixels(self, image: _Places) -> _Places:
        """Columns and rows (the first pixel's centre at 0.5) of places (x / z, y / z) of the camera's frame."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.center
        return image * np.array([fx, fy], image.dtype) + np.array([cx * self.width, cy * self.height], image.dtype)

    @eqx.filter_jit
    def rays(self, pose: Pose) -> tuple[Float[Array, "*batch rays 3"], Float[Array, "*batch rays 3"]]:
        """Origins and unit directions of all rays in the scene, for one pose or a batch."""
        directions = self.pixel_directions()
        directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
        directions = jnp.einsum("...ij,rj->...ri", pose.rotation, directions, precision="highest")
        return jnp.broadcast_to(pose.position[..., None, :], directions.shape), directions
