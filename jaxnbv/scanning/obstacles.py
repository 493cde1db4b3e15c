"""Known obstacles: what they hide, and where a camera may not stand because of them."""

import dataclasses
import functools
import operator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import AnyArray, check_fields, check_type, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.neighbours import nearest_squared_distance
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.tensor_grid import on_tensor_grid
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.sdf import Rotated, SignedDistance
from jaxnbv.scanning.sphere_tracing import SDFSurface

# Beyond this distance from the scene's origin nothing stands in the way of a camera.
_FAR = 8.0


class Obstacles(eqx.Module):
    """Known solids, and how near a camera may come to things; in scene units within a `Planner`.

    An obstacle hides what is behind it, from the sensor and from imagined scans; it is never counted as the object, and
    no imagined surface is within it.

    - `solids`: solids of `jaxnbv.scanning.sdf`: a table is a `HalfSpace`, a mesh is made one by `solid_of_mesh`.
    - `margin`: points nearer than this to an obstacle are taken for its own.
    - `clearance`: no camera comes nearer than this to an obstacle, nor to a point that was seen.
    - `clutter`: what else stands there, known coarsely: it hides and keeps cameras away as solids do, but no point is
      taken for its own and imagined surfaces may go through it. A session finds it in its images.

    **Raises:** `ValueError` for solids that are not solids, or a negative length.
    """

    solids: tuple[SignedDistance, ...] = ()
    # Arrays, so that what was compiled for one scale runs for any.
    margin: float = eqx.field(converter=np.float64, default=0.03)
    clearance: float = eqx.field(converter=np.float64, default=0.1)
    clutter: SignedDistance | None = None

    def __check_init__(self):
        check_fields(self)
        require(isinstance(self.solids, tuple), f"the solids are {shown(self.solids)}; give a tuple of solids")
        for obstacle in self.solids:
            check_type(obstacle, SignedDistance, "an obstacle")
        for name in ("margin", "clearance"):
            value = getattr(self, name)
            require(value >= 0, f"the {name} is {value}; it must not be negative")

    def in_scene(self, frame: Frame) -> "Obstacles":
        """From world units to those of the scene."""

        def moved(solid: SignedDistance) -> SignedDistance:
            return Rotated(solid.translate(-np.asarray(frame.center)), frame.rotation).scale(frame.scale)

        clutter = None if self.clutter is None else moved(self.clutter)
        solids = tuple(map(moved, self.solids))
        return Obstacles(solids, frame.scale * self.margin, frame.scale * self.clearance, clutter)

    def with_clutter(self, clutter: SignedDistance | None) -> "Obstacles":
        """The same solids with other clutter, None for none."""
        # Runs under jit, where a new one would convert its lengths.
        return eqx.tree_at(lambda known: known.clutter, self, clutter, is_leaf=lambda leaf: leaf is None)

    def distance(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """Signed distance to the nearest solid, infinite where there is none."""
        return _distance(self.solids, x)

    def barrier(self, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
        """How far along each ray of a camera the first obstacle stands, clutter included; infinite where none does,
        None without any."""
        if not self._all:
            return None
        origins, directions = camera.rays(poses)
        surface = SDFSurface(functools.reduce(operator.or_, self._all), bounding_radius=_FAR)
        hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
        along = jnp.linalg.norm(hits.points - origins.reshape(-1, 3), axis=-1)
        return jnp.where(hits.mask, along, jnp.inf).reshape(origins.shape[:-1])

    def remove_points(self, scan: PointCloud) -> PointCloud:
        """A scan less the points of solids; of an image, their rays met nothing of the object."""
        own = scan.mask & (self.distance(scan.points) < self.margin)
        missed = None if scan.missed is None else scan.missed | own
        return dataclasses.replace(scan.only(~own), missed=missed)

    @eqx.filter_jit
    def within(self, grid: Grid) -> Bool[Array, "g g g"]:
        """The nodes of a grid that lie within an obstacle."""
        axis = jnp.asarray(grid.axis, jnp.result_type(float))
        return on_tensor_grid(lambda x: self.distance(x) < 0, axis)

    def violation(self, poses: Pose, cloud: PointCloud) -> Float[Array, " poses"]:
        """By how much each of a batch of cameras is too near to an obstacle or to D, in scene units; zero where it is
        not. Differentiable."""
        seen = jnp.sqrt(jnp.maximum(nearest_squared_distance(poses.position, cloud), 1e-12))
        return jnp.maximum(self.clearance - jnp.minimum(_distance(self._all, poses.position), seen), 0.0)

    @property
    def _all(self) -> tuple[SignedDistance, ...]:
        return self.solids if self.clutter is None else (*self.solids, self.clutter)


def _distance(solids: tuple[SignedDistance, ...], x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
    if not solids:
        return jnp.full(jnp.shape(x)[:-1], jnp.inf, jnp.result_type(float))
    return functools.reduce(operator.or_, solids)(x)


def barrier_of(obstacles: Obstacles | None, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
    """`Obstacles.barrier`; None without obstacles."""
    return None if obstacles is None else obstacles.barrier(camera, poses)
