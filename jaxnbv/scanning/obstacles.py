"""Known obstacles, which hide the scene behind them and keep cameras away."""

import dataclasses
import functools
import operator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import AnyArray, check_fields, check_type, require, short_text
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.neighbours import nearest_squared_distance
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.programs import program
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.sdf import Rotated, SignedDistance
from jaxnbv.scanning.sphere_tracing import SDFSurface

# Obstacles farther than this from the scene's origin hide nothing.
_MAX_DISTANCE = 8.0


class Obstacles(eqx.Module):
    """Known solids beside the object, and the distance that cameras keep from them and from the object.

    Lengths are in scene units within a `Planner`. An obstacle hides everything behind it, both from the sensor and in
    scans of samples. Points of an obstacle are removed from scans, and samples have no surface inside an obstacle.

    - `solids`: a tuple of solids of `jaxnbv.sdf`, such as a `HalfSpace` for a table, or of `solid_of_mesh`.
    - `margin`: a scanned point nearer than this to a solid counts as a point of the solid.
    - `clearance`: least distance of a camera from an obstacle and from a scanned point.
    - `clutter`: a solid for other things nearby, whose rough shape a session computes from its images. It hides what is
      behind it and keeps cameras away, but points near it are not removed, and samples may have surface inside it.

    **Raises:** `ValueError` if `solids` is not a tuple of solids, or for a negative length.
    """

    solids: tuple[SignedDistance, ...] = ()
    # The lengths are arrays, so that a program compiled for one scale of the scene runs for any scale.
    margin: float = eqx.field(converter=np.float64, default=0.03)
    clearance: float = eqx.field(converter=np.float64, default=0.1)
    clutter: SignedDistance | None = None

    def __check_init__(self):
        check_fields(self)
        require(isinstance(self.solids, tuple), f"the solids are {short_text(self.solids)}; give a tuple of solids")
        for obstacle in self.solids:
            check_type(obstacle, SignedDistance, "an obstacle")
        for name in ("margin", "clearance"):
            value = getattr(self, name)
            require(value >= 0, f"the {name} is {value}; it must not be negative")

    def in_scene(self, frame: Frame) -> "Obstacles":
        """Convert obstacles in world coordinates to scene coordinates."""

        def to_scene(solid: SignedDistance) -> SignedDistance:
            return Rotated(solid.translate(-np.asarray(frame.center)), frame.rotation).scale(frame.scale)

        clutter = None if self.clutter is None else to_scene(self.clutter)
        solids = tuple(map(to_scene, self.solids))
        return Obstacles(solids, frame.scale * self.margin, frame.scale * self.clearance, clutter)

    def with_clutter(self, clutter: SignedDistance | None) -> "Obstacles":
        """Return a copy whose clutter is replaced by `clutter`; None removes the clutter."""
        # The constructor would convert the lengths with NumPy, which fails under jit.
        return eqx.tree_at(lambda obstacles: obstacles.clutter, self, clutter, is_leaf=lambda leaf: leaf is None)

    def distance(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """Return the signed distance from each point x to the nearest solid; infinite if there are no solids."""
        return _distance(self.solids, x)

    def barrier(self, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
        """Return each ray's distance (scene units) to the first obstacle or clutter; infinite if it hits none.

        Returns None if there are neither obstacles nor clutter.
        """
        if not self._all:
            return None
        origins, directions = camera.rays(poses)
        surface = SDFSurface(functools.reduce(operator.or_, self._all), bounding_radius=_MAX_DISTANCE)
        hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
        distance = jnp.linalg.norm(hits.points - origins.reshape(-1, 3), axis=-1)
        return jnp.where(hits.mask, distance, jnp.inf).reshape(origins.shape[:-1])

    @program
    def remove_points(self, scan: PointCloud) -> PointCloud:
        """Remove points within `margin` of a solid from a scan. In a sensor's image, their rays become missed."""
        is_obstacle = scan.mask & (self.distance(scan.points) < self.margin)
        missed = None if scan.missed is None else scan.missed | is_obstacle
        return dataclasses.replace(scan.only(~is_obstacle), missed=missed)

    @program
    def within(self, grid: Grid) -> Bool[Array, "g g g"]:
        """Return, for each node of a grid, whether it lies inside a solid."""
        return on_tensor_grid(lambda x: self.distance(x) < 0, grid.axis)

    def violation(self, poses: Pose, cloud: PointCloud) -> Float[Array, " poses"]:
        """Return by how much each camera is closer than `clearance` to an obstacle or a point of the cloud.

        The result is in scene units, zero for a camera that is far enough away, and differentiable in the poses.
        """
        to_cloud = jnp.sqrt(jnp.maximum(nearest_squared_distance(poses.position, cloud), 1e-12))
        return jnp.maximum(self.clearance - jnp.minimum(_distance(self._all, poses.position), to_cloud), 0.0)

    @property
    def _all(self) -> tuple[SignedDistance, ...]:
        return self.solids if self.clutter is None else (*self.solids, self.clutter)


def _distance(solids: tuple[SignedDistance, ...], x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
    if not solids:
        return jnp.full(jnp.shape(x)[:-1], jnp.inf, jnp.result_type(float))
    return functools.reduce(operator.or_, solids)(x)


def barrier_of(obstacles: Obstacles | None, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
    """Return `obstacles.barrier(camera, poses)`; None if there are no obstacles."""
    return None if obstacles is None else obstacles.barrier(camera, poses)
