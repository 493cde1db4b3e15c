"""The frame that carries the user's world into the scene."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray, as_numbers, check_fields, checked, is_traced, require, shown
from jaxnbv.cloud import PointCloud
from jaxnbv.pose import Pose

# Of the sensor's noise a hundredth.
_ROUNDING = 1e-4


class Frame(eqx.Module):
    """The similarity between the user's world and the scene: scene = scale (world - center).

    - `scale`: scene units per world unit.
    - `center`: the world point that becomes the scene's origin.
    """

    scale: float = 1.0
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __check_init__(self):
        check_fields(self)
        require(self.scale > 0, f"the frame's scale is {self.scale}; it must be positive")

    @classmethod
    @checked
    def fit(cls, points: Float[AnyArray, "n 3"], longest_side: float = 2.5) -> "Frame":
        """The frame in which the points' bounding box is centred and its longest side is `longest_side`.

        **Raises:** `ValueError` if there are no points, or they all coincide, or one is not finite.
        """
        points = as_numbers(points, "points", np.float64)
        require(points.ndim == 2 and points.shape[1] == 3, f"the points must be (n, 3), got {points.shape}")
        require(len(points) > 0, "cannot fit a frame to no points: give the points of the object")
        require(bool(np.isfinite(points).all()), "cannot fit a frame to points that are not finite: drop them first")
        low, high = points.min(axis=0), points.max(axis=0)
        extent = float((high - low).max())
        require(extent > 0, f"cannot fit a frame: all {len(points)} points lie at {low}; give points that differ")
        x, y, z = (0.5 * (low + high)).tolist()
        return cls(longest_side / extent, (x, y, z))

    def to_scene(self, thing):
        """World to scene, for an array of points (..., 3), a `PointCloud` or a `Pose`. Directions stay as they are.

        Clouds and poses are kept in JAX's floating-point type; far from the world's origin, as in coordinates of a map,
        bring arrays to the scene before they are made of them.

        **Raises:** `ValueError` for a cloud or a pose whose coordinates are rounded by more than 1e-4 scene units.
        """
        if isinstance(thing, PointCloud | Pose) and not is_traced(thing):
            self._check_precision(thing.points if isinstance(thing, PointCloud) else thing.position)
        return self._apply(thing, lambda points: (points - np.asarray(self.center)) * self.scale)

    def to_world(self, thing):
        """Scene to world, for an array of points (..., 3), a `PointCloud` or a `Pose`."""
        return self._apply(thing, lambda points: points / self.scale + np.asarray(self.center))

    def _check_precision(self, coordinates: Array) -> None:
        largest = float(np.abs(np.asarray(coordinates)).max(initial=0.0))
        rounding = self.scale * largest * float(jnp.finfo(coordinates.dtype).eps)
        require(
            rounding <= _ROUNDING,
            f"world coordinates of {largest:.4g} are rounded to {rounding:.2g} scene units as {coordinates.dtype}: "
            "bring the arrays to the scene first, PointCloud.from_arrays(frame.to_scene(points), normals), or enable "
            "jax_enable_x64",
        )

    def _apply(self, thing, transform):
        if isinstance(thing, PointCloud):
            points = jnp.where(thing.mask[..., None], transform(thing.points), 0.0)
            return PointCloud(points.astype(thing.points.dtype), thing.normals, thing.mask, thing.missed)
        if isinstance(thing, Pose):
            return Pose(thing.rotation, transform(thing.position).astype(thing.position.dtype))
        if isinstance(thing, Array) and is_traced(thing):
            return transform(thing)
        found = as_numbers(thing, "the points", None)
        require(found.shape[-1:] == (3,), f"the points are {shown(thing)}: give an array (..., 3), a cloud or a pose")
        return transform(found)
