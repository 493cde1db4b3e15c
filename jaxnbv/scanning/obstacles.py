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
_FAR = 8.0


class Obstacles(eqx.Module):
    """Known solids, and the distance that a camera keeps from things; in scene units within a `Planner`.

    An obstacle hides everything behind it, both from the sensor and in scans of samples. It never counts as the object,
    and samples are empty inside it.

    - `solids`: solids of `jaxnbv.scanning.sdf`, such as a `HalfSpace` for a table or `solid_of_mesh` for a mesh.
    - `margin`: points nearer than this to a solid count as points of the solid.
    - `clearance`: least distance of a camera from an obstacle and from a scanned point.
    - `clutter`: other things nearby, known coarsely. Clutter hides and keeps cameras away as solids do, but no point
      counts as its own and samples may go through it. A session derives it from its images.

    **Raises:** `ValueError` if `solids` holds anything else, or for a negative length.
    """

    solids: tuple[SignedDistance, ...] = ()
    # Arrays, so that a program compiled for one scale runs for any.
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
        """A copy in scene coordinates of obstacles in world coordinates."""

        def moved(solid: SignedDistance) -> SignedDistance:
            return Rotated(solid.translate(-np.asarray(frame.center)), frame.rotation).scale(frame.scale)

        clutter = None if self.clutter is None else moved(self.clutter)
        solids = tuple(map(moved, self.solids))
        return Obstacles(solids, frame.scale * self.margin, frame.scale * self.clearance, clutter)

    def with_clutter(self, clutter: SignedDistance | None) -> "Obstacles":
        """A copy with other clutter; None removes it."""
        # Not the constructor, whose conversion of lengths fails under jit.
        return eqx.tree_at(lambda obstacles: obstacles.clutter, self, clutter, is_leaf=lambda leaf: leaf is None)

    def distance(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """Signed distance from each point to the nearest solid; infinite if there is none."""
        return _distance(self.solids, x)

    def barrier(self, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
        """Distance along each ray of a camera to the first obstacle, clutter included.

        Infinite for a ray that meets none; None if there are no obstacles.
        """
        if not self._all:
            return None
        origins, directions = camera.rays(poses)
        surface = SDFSurface(functools.reduce(operator.or_, self._all), bounding_radius=_FAR)
        hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
        distance = jnp.linalg.norm(hits.points - origins.reshape(-1, 3), axis=-1)
        return jnp.where(hits.mask, distance, jnp.inf).reshape(origins.shape[:-1])

    @program
    def remove_points(self, scan: PointCloud) -> PointCloud:
        """The scan without the points that belong to solids. In a sensor's image their rays become missed."""
        own = scan.mask & (self.distance(scan.points) < self.margin)
        missed = None if scan.missed is None else scan.missed | own
        return dataclasses.replace(scan.only(~own), missed=missed)

    @program
    def within(self, grid: Grid) -> Bool[Array, "g g g"]:
        """Whether each node of a grid lies inside a solid."""
        axis = jnp.asarray(grid.axis, jnp.result_type(float))
        return on_tensor_grid(lambda x: self.distance(x) < 0, axis)

    def violation(self, poses: Pose, cloud: PointCloud) -> Float[Array, " poses"]:
        """How far each camera violates `clearance` to the obstacles and the cloud D, in scene units.

        It is zero for a camera that is far enough away. Differentiable.
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
    """`Obstacles.barrier` of these obstacles; None if there are none."""
    return None if obstacles is None else obstacles.barrier(camera, poses)
