"""The frame that maps the user's world to the scene: its origin, unit of length and upward axis."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import (
    AnyArray,
    as_numbers,
    check_fields,
    checked,
    is_traced,
    on_host,
    own_settings,
    require,
    short_text,
)
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box

# Largest rounding of coordinates, in scene units: 1 % of the sensor noise.
_MAX_ROUNDING = 1e-4
# Rotation from world to scene for each upward axis of the world. The second row is this axis, the scene's y axis.
_UP_ROTATIONS = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
}
AXES = tuple(_UP_ROTATIONS)


class Frame(eqx.Module):
    """The similarity transform from the user's world to the scene: scene = scale R (world - center).

    - `scale`: scene units per world unit.
    - `center`: the world point that becomes the scene's origin.
    - `up`: the world's upward axis, which becomes the scene's y axis: "y" (R is the identity), "z" (most robots), "x",
      "-y", "-z" or "-x".

    **Raises:** `ValueError` for a scale that is not positive, or an `up` that is none of these axes.
    """

    scale: float = 1.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: str = eqx.field(static=True, default="y")

    def __check_init__(self):
        check_fields(self)
        require(self.scale > 0, f"the frame's scale is {self.scale}; it must be positive")
        require(self.up in _UP_ROTATIONS, f"up is {short_text(self.up)}; give one of {', '.join(_UP_ROTATIONS)}")

    @classmethod
    @checked
    def fit(cls, points: Float[AnyArray, "n 3"], longest_side: float = 2.5, up: str = "y") -> "Frame":
        """Return the frame that centres the bounding box of points (world), and scales its longest side.

        The longest side becomes `longest_side`, in scene units.

        **Raises:** `ValueError` if there are no points, if all points coincide, or if a point is not finite.
        """
        points = as_numbers(points, "points", np.float64)
        require(points.ndim == 2 and points.shape[1] == 3, f"the points must be (n, 3), got {points.shape}")
        require(len(points) > 0, "cannot fit a frame to no points: give the points of the object")
        require(bool(np.isfinite(points).all()), "cannot fit a frame to points that are not finite: drop them first")
        low, high = points.min(axis=0), points.max(axis=0)
        extent = float((high - low).max())
        require(extent > 0, f"cannot fit a frame: all {len(points)} points lie at {low}; give points that differ")
        x, y, z = (0.5 * (low + high)).tolist()
        return cls(longest_side / extent, (x, y, z), up)

    @property
    def unit(self) -> str:
        """Name of the world's unit of length: "scene units" if the frame is the identity, else "world units"."""
        identity = self.scale == 1.0 and self.center == (0.0, 0.0, 0.0) and self.up == "y"
        return "scene units" if identity else "world units"

    @own_settings()
    def length_to_world(self, length: Float[AnyArray, "*n"] | float, power: int = 1):
        """Convert a length (power 1), an area (power 2) or a volume (power 3) from scene units to world units."""
        return length / self.scale**power

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The rotation R, which maps directions from the world to the scene."""
        return np.array(_UP_ROTATIONS[self.up], np.float64)

    @own_settings()
    def to_scene(self, value):
        """Convert points (..., 3), a `PointCloud`, a `Pose`, a `Box` or a `Camera` from world to scene.

        For a camera, only the limits of its range change. Clouds and poses have JAX's floating-point type, which is too
        coarse for coordinates far from the world's origin, such as map coordinates. Convert such coordinates as NumPy
        arrays of float64, and build clouds and poses from the result.

        **Raises:** `ValueError` for a cloud or a pose whose coordinates are rounded by more than 1e-4 scene units.
        """
        if isinstance(value, PointCloud | Pose) and not is_traced(value):
            self._check_precision(value.points if isinstance(value, PointCloud) else value.position)
        center = np.asarray(self.center)
        return _apply(value, lambda points: self._rotate(points - center) * self.scale, self._rotate, self.scale)

    @own_settings()
    def to_world(self, value):
        """Convert from scene to world: the inverse of `to_scene`, for the same types."""
        center = np.asarray(self.center)
        return _apply(
            value, lambda points: self._unrotate(points / self.scale) + center, self._unrotate, 1.0 / self.scale
        )

    def _rotate(self, vectors):
        return vectors if self.up == "y" else vectors @ self.rotation.T.astype(vectors.dtype)

    def _unrotate(self, vectors):
        return vectors if self.up == "y" else vectors @ self.rotation.astype(vectors.dtype)

    def _check_precision(self, coordinates: Array) -> None:
        largest = float(np.abs(np.asarray(coordinates)).max(initial=0.0))
        rounding = self.scale * largest * float(jnp.finfo(coordinates.dtype).eps)
        require(
            rounding <= _MAX_ROUNDING,
            f"world coordinates of {largest:.4g} are rounded to {rounding:.2g} scene units as {coordinates.dtype}: "
            "bring the arrays to the scene first, PointCloud.from_arrays(frame.to_scene(points), normals), or enable "
            "jax_enable_x64",
        )


def _apply(value, map_points, map_directions, scale: float):
    """Convert a value by a function for points, a function for directions, and a factor for lengths."""
    if isinstance(value, PointCloud | Pose):
        xp, arrays = jnp if is_traced(value) else np, on_host(value)
    if isinstance(value, PointCloud):
        points = xp.where(arrays.mask[..., None], map_points(arrays.points), 0.0).astype(arrays.points.dtype)
        sight = None if arrays.sight is None else jnp.asarray(scale * arrays.sight)
        normals = jnp.asarray(map_directions(arrays.normals))
        return dataclasses.replace(value, points=jnp.asarray(points), normals=normals, sight=sight)
    if isinstance(value, Pose):
        rotation = xp.swapaxes(map_directions(xp.swapaxes(arrays.rotation, -1, -2)), -1, -2)
        return Pose(rotation, map_points(arrays.position).astype(arrays.position.dtype))
    if isinstance(value, Box):
        corners = map_points(np.array([value.low, value.high]))
        return Box(corners.min(axis=0), corners.max(axis=0))
    if isinstance(value, Camera):
        farthest = None if value.farthest is None else scale * value.farthest
        return dataclasses.replace(value, nearest=scale * value.nearest, farthest=farthest)
    if isinstance(value, Array) and is_traced(value):
        return map_points(value)
    array = as_numbers(value, "the points", None)
    require(array.shape[-1:] == (3,), f"the points are {short_text(value)}: give an array (..., 3), a cloud or a pose")
    return map_points(array)
