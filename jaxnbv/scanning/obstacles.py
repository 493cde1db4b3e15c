"""What stands around the object, and where cameras may not be for it."""

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
from jaxnbv.geometry.volume import Box
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.sdf import HalfSpace, Rotated, SignedDistance
from jaxnbv.scanning.sphere_tracing import SDFSurface

# Beyond this distance from the scene's origin nothing stands in the way of a camera.
_FAR = 8.0
# A table goes on beside the box, by so much of the box's longest side at least, and may lie so little below it. Of the
# points beside the box most are on it, of those in the box none is below it, and so many of all are on it.
_BESIDE, _BELOW = 0.2, 0.05
_MOST, _NONE, _SOME = 0.5, 0.02, 50
_LEVEL = np.cos(np.radians(15.0))
_TOLERANCE = 0.03
# Planes that are tried, and points that each is tried on.
_DRAWS, _COUNTED = 500, 5000
# The share of the points that a plane has at least.
_FEWEST = 0.05


class Obstacles(eqx.Module):
    """Known solids, and how near a camera may come to things; in scene units within a `Planner`.

    An obstacle hides what is behind it, from the sensor and from imagined scans; it is never counted as the object, and
    no imagined surface is within it.

    - `solids`: solids of `jaxnbv.scanning.sdf`: a table is a `HalfSpace`, a mesh is made one by `solid_of_mesh`.
    - `margin`: points nearer than this to an obstacle are taken for its own.
    - `clearance`: no camera comes nearer than this to an obstacle, nor to a point that was seen.

    **Raises:** `ValueError` for solids that are not solids, or a negative length.
    """

    solids: tuple[SignedDistance, ...] = ()
    margin: float = eqx.field(static=True, default=0.03)
    clearance: float = eqx.field(static=True, default=0.1)

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
        moved = (obstacle.translate(-np.asarray(frame.center)) for obstacle in self.solids)
        solids = tuple(Rotated(solid, frame.rotation).scale(frame.scale) for solid in moved)
        return Obstacles(solids, frame.scale * self.margin, frame.scale * self.clearance)

    def distance(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """Signed distance to the nearest obstacle, infinite where there is none."""
        if not self.solids:
            return jnp.full(jnp.shape(x)[:-1], jnp.inf, jnp.result_type(float))
        return functools.reduce(operator.or_, self.solids)(x)

    def barrier(self, camera: Camera, poses: Pose) -> Float[Array, "*batch rays"] | None:
        """How far along each ray of a camera the first obstacle stands; infinite where none does, None without any."""
        if not self.solids:
            return None
        origins, directions = camera.rays(poses)
        surface = SDFSurface(functools.reduce(operator.or_, self.solids), bounding_radius=_FAR)
        hits = surface.trace(origins.reshape(-1, 3), directions.reshape(-1, 3))
        along = jnp.linalg.norm(hits.points - origins.reshape(-1, 3), axis=-1)
        return jnp.where(hits.mask, along, jnp.inf).reshape(origins.shape[:-1])

    def remove_points(self, scan: PointCloud) -> PointCloud:
        """A scan less the points of solids; of an image, their rays met nothing of the object."""
        own = scan.mask & (self.distance(scan.points) < self.margin)
        points, normals = (jnp.where(own[..., None], 0.0, rows) for rows in (scan.points, scan.normals))
        missed = None if scan.missed is None else scan.missed | own
        return PointCloud(points, normals, scan.mask & ~own, missed)

    def within(self, grid: Grid) -> Bool[Array, "g g g"]:
        """The nodes of a grid that lie within an obstacle."""
        axis = jnp.asarray(grid.axis, jnp.result_type(float))
        return on_tensor_grid(lambda x: self.distance(x) < 0, axis)

    def is_excluded(self, poses: Pose, cloud: PointCloud) -> Bool[Array, " poses"]:
        """Whether a camera may not stand at each of a batch of poses, given the points D."""
        return self.violation(poses, cloud) > 0

    def violation(self, poses: Pose, cloud: PointCloud) -> Float[Array, " poses"]:
        """By how much each of a batch of cameras is too near to an obstacle or to D, in scene units; zero where it is
        not. Differentiable."""
        seen = jnp.sqrt(jnp.maximum(nearest_squared_distance(poses.position, cloud), 1e-12))
        return jnp.maximum(self.clearance - jnp.minimum(self.distance(poses.position), seen), 0.0)


def plane_under(cloud: PointCloud, box: Box) -> HalfSpace | None:
    """The plane that an object in a box stands on, and all below it; None where a cloud shows none. In scene
    coordinates, with y up.

    It is the plane of most points in the box and beside it, and level to 15 degrees. It goes on beside the box, which
    the top of a table that *is* the object does not, and no more than 2 % of the points in the box are below it.
    """
    points, _ = cloud.to_numpy()
    low, high = np.array(box.low), np.array(box.high)
    side = float((high - low).max())
    beside, below = side * _BESIDE * np.array([1.0, 0.0, 1.0]), side * _BELOW * np.array([0.0, 1.0, 0.0])
    near = points[((points > low - beside - below) & (points < high + beside)).all(axis=1)].astype(np.float64)
    inside = ((near > low - below) & (near < high)).all(axis=1)
    if min(inside.sum(), (~inside).sum()) < _SOME:
        return None
    plane = _plane_of_most(near)
    if plane is None:
        return None
    point, normal = plane
    normal = np.sign(normal[1]) * normal
    height = (near - point) @ normal
    on = np.abs(height) <= _TOLERANCE
    found = (
        normal[1] >= _LEVEL
        and on[~inside].sum() >= _SOME
        and on[~inside].mean() >= _MOST
        and (height[inside] < -_TOLERANCE).mean() <= _NONE
    )
    return HalfSpace(point, normal) if found else None


def _plane_of_most(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
    """A point and the normal of it, by RANSAC (Fischler and Bolles 1981): of planes through three points drawn at
    random the one that most points are near, then the best fit to these. None where all lie on a line, or fewer than a
    twentieth are near."""
    draw = np.random.default_rng(0)
    a, b, c = np.moveaxis(points[draw.integers(0, len(points), (_DRAWS, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    few = draw.choice(points, min(len(points), _COUNTED), replace=False)
    near = np.abs(few @ normals.T - np.sum(a * normals, axis=1)) <= _TOLERANCE
    # Three points on a line have no normal.
    best = np.argmax(np.where(normals.any(axis=1), near.sum(axis=0), -1))
    on = points[np.abs((points - a[best]) @ normals[best]) <= _TOLERANCE]
    if not normals[best].any() or len(on) < max(3, _FEWEST * len(points)):
        return None
    middle = on.mean(axis=0)
    return middle, np.linalg.eigh((on - middle).T @ (on - middle))[1][:, 0]
