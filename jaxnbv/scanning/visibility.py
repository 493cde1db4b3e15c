"""Evenly spread points on a sampled surface, and a test of which points a camera sees from a pose."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.programs import program
from jaxnbv.scanning import tracing
from jaxnbv.scanning.grid import GridSurface
from jaxnbv.scanning.metrics import GRAZING
from jaxnbv.scanning.scanner import Surface

# Number of poses per batch. The rays through one sample then fit a CPU's cache.
_POSES = 32


class SurfacePoints(NamedTuple):
    """Points of a surface with their normals and areas, in scene units.

    - `normals`: unit normals that point outward.
    - `areas`: area of the surface that each point represents, in squared scene units; zero if the surface is empty.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    areas: Float[Array, " n"]


@program
def spread_points(surface: GridSurface, count: int) -> SurfacePoints:
    """Return points where a surface crosses edges of its grid, chosen evenly among the crossed edges.

    A plane with unit normal n crosses |n_x| + |n_y| + |n_z| edges per squared grid spacing of its area. So each crossed
    edge represents an area of 1 / (|n_x| + |n_y| + |n_z|) squared spacings (Cauchy-Crofton formula). Points repeat if
    there are fewer than `count` crossed edges.
    """
    values, grid = surface.values, surface.grid
    is_inside = values <= 0
    # The last node along an axis has no neighbour ahead.
    is_crossed = [
        jnp.pad(jnp.diff(is_inside, axis=axis), [(0, int(other == axis)) for other in range(3)]) for axis in range(3)
    ]
    num_crossed = jnp.cumsum(jnp.stack(is_crossed).reshape(-1))
    # Take one random edge in each of `count` equal intervals. With a fixed stride, the points could line up along the
    # grid's rows.
    offsets = jax.random.uniform(jax.random.key(0), (count,))
    ranks = (jnp.arange(count) + offsets) / count * num_crossed[-1]
    edge = jnp.searchsorted(num_crossed, ranks, side="right").clip(0, num_crossed.size - 1)
    axis, *node = jnp.unravel_index(edge, (3, *values.shape))
    step = jnp.eye(3, dtype=node[0].dtype)[axis]
    first_node, second_node = jnp.stack(node, axis=-1), jnp.stack(node, axis=-1) + step
    low, high = values[tuple(first_node.T)], values[tuple(second_node.T)]
    fraction = jnp.where(low == high, 0.5, low / jnp.where(low == high, 1.0, low - high))
    positions = first_node + fraction[:, None] * step
    field = tracing.GridField(values.reshape(-1), surface.distance.reshape(-1), grid.resolution)
    gradient = jnp.stack(tracing.smooth_gradient(field, list(positions.T)), axis=-1)
    length = jnp.linalg.norm(gradient, axis=-1, keepdims=True)
    normals = gradient / jnp.where(length > 0, length, 1.0)
    edges = jnp.sum(jnp.abs(normals), axis=-1)
    area_per_point = grid.spacing**2 * num_crossed[-1] / count
    areas = jnp.where(edges > 0, area_per_point / jnp.where(edges > 0, edges, 1.0), 0.0)
    return SurfacePoints(grid.spacing * positions - grid.half_extent, normals, areas)


def is_visible(
    surface: Surface,
    camera: Camera,
    poses: Pose,
    points: SurfacePoints,
    tolerance: float,
    barrier: Float[Array, "poses rays"] | None = None,
) -> Bool[Array, "poses n"]:
    """Return, for each pose of a batch and each point of a surface, whether a camera sees the point.

    A camera sees a point that lies in the camera's image and range, is not at a grazing angle, and is not hidden.

    - `tolerance`: the surface hides a point if a ray hits it more than this length (scene units) before the point.
    - `barrier`: distance along each ray of the camera to an obstacle, see `Obstacles.barrier`.
    """

    def from_pose(inputs: tuple[Pose, Float[Array, " rays"] | None]) -> Bool[Array, " n"]:
        pose, barrier = inputs
        offset = points.points - pose.position
        distance = jnp.linalg.norm(offset, axis=-1)
        directions = offset / jnp.where(distance > 0, distance, 1.0)[:, None]
        local = jnp.matmul(offset, pose.rotation, precision="highest")
        depth = local[:, 2]
        is_seen = (depth > 0) & (depth >= camera.nearest)
        if camera.farthest is not None:
            is_seen &= depth <= camera.farthest
        column, row = jnp.floor(camera.to_pixels(local[:, :2] / jnp.where(is_seen, depth, 1.0)[:, None])).T
        is_seen &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        cosine = -jnp.sum(directions * points.normals, axis=-1)
        is_seen &= cosine >= max(GRAZING, math.cos(camera.max_incidence))
        hits = surface.trace(jnp.broadcast_to(pose.position, offset.shape), directions)
        is_seen &= hits.mask & (jnp.linalg.norm(hits.points - pose.position, axis=-1) >= distance - tolerance)
        if barrier is None:
            return is_seen
        pixel = jnp.where(is_seen, row * camera.width + column, 0).astype(jnp.int32)
        return is_seen & (distance < barrier[pixel])

    return jax.lax.map(from_pose, (poses, barrier), batch_size=_POSES)
