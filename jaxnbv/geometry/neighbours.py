"""Distances from many points to a cloud, either exact or with a grid that stores nearest points."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.geometry.cloud import PointCloud, some_rows

_UNROLL = 8
# Number of points whose nearest neighbours `spacing` computes.
_NUM_QUERIES = 256


@jax.jit
def nearest_squared_distance(x: Float[Array, "n 3"], cloud: PointCloud) -> Float[Array, " n"]:
    """Return min_j |x - y_j|^2 over the filled rows y_j of a cloud; infinite if the cloud is empty.

    Memory is linear in n. Rows after the last filled row cost no time. The result can be differentiated any number of
    times, in x and in the cloud's points.
    """
    return _nearest_squared_distance(x, cloud.points, cloud.mask)


def spacing(cloud: PointCloud) -> Float[Array, ""]:
    """Return the median distance from a point of a cloud to its nearest neighbour, in the cloud's units.

    The median is over 256 evenly spaced filled rows. It is zero for a cloud with fewer than two points.
    """
    nearest = distance_to_others(cloud, some_rows(cloud, _NUM_QUERIES))
    return jnp.where(cloud.count > 1, jnp.median(nearest), 0.0)


def distance_to_others(cloud: PointCloud, rows: Int[Array, " r"]) -> Float[Array, " r"]:
    """Return the distance from the point in each of `rows` to the nearest other point; infinite if none."""
    offsets = cloud.points[rows, None] - cloud.points
    is_other = cloud.mask & (jnp.arange(cloud.capacity) != rows[:, None])
    return jnp.sqrt(jnp.min(jnp.where(is_other, jnp.sum(offsets**2, axis=-1), jnp.inf), axis=1))


class NearestPoints(eqx.Module):
    """The points of a cloud, with a cubic grid to look up the nearest of them. Fast for many queries.

    Each node of the grid stores its nearest point. The distance from x is the distance to the nearest of the points
    that the eight nodes around x store. So it is never too small. It is too large only if none of these nodes stores
    the nearest point of x, and then by at most twice the distance from x to the nearest node.

    - `index`: row of the nearest point of each node.
    - `low`, `spacing`: position of the first node, and distance between neighbouring nodes, in the cloud's units.
    """

    cloud: PointCloud
    index: Int[Array, "n n n"]
    low: Float[Array, "3"]
    spacing: Float[Array, ""]

    @classmethod
    def of(cls, cloud: PointCloud, resolution: int = 64) -> "NearestPoints":
        """Find the nearest point of each node.

        - `resolution`: number of nodes along each side of the grid. The grid is a cube about the centre of the cloud,
          with sides 1.5 times as long as the longest side of the cloud's bounding box.
        """
        filled = cloud.mask[:, None] | (cloud.count == 0)
        low = jnp.min(jnp.where(filled, cloud.points, jnp.inf), axis=0)
        high = jnp.max(jnp.where(filled, cloud.points, -jnp.inf), axis=0)
        half_side = jnp.maximum(0.75 * jnp.max(high - low), jnp.finfo(low.dtype).eps)
        first, spacing = 0.5 * (low + high) - half_side, 2.0 * half_side / (resolution - 1)
        nodes = first + spacing * jnp.stack(jnp.meshgrid(*[jnp.arange(resolution)] * 3, indexing="ij"), axis=-1)
        index = _nearest_index(nodes.reshape(-1, 3), cloud.points, cloud.mask)
        return cls(cloud, index.reshape(nodes.shape[:-1]), first, spacing)

    def __call__(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return the distance from each point x to the cloud, see `squared_distance`."""
        # The derivative of the square root is infinite at zero.
        squared = self.squared_distance(x)
        return jnp.sqrt(jnp.maximum(squared, jnp.finfo(squared.dtype).tiny))

    def squared_distance(self, x: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Return the squared distance from each point x to the cloud; infinite if the cloud is empty.

        A point outside the grid gets the nearest of the points that the nearest cell stores. The result can be
        differentiated any number of times, in x and in the cloud's points.
        """
        resolution = len(self.index)
        cell = jnp.clip((x - self.low) / self.spacing, 0.0, resolution - 2).astype(jnp.int32)
        index, squared = self.index.ravel(), jnp.full(len(x), jnp.inf, x.dtype)
        nearest = jnp.zeros(len(x), jnp.int32)
        for corner in itertools.product(range(2), repeat=3):
            i, j, k = (cell + np.array(corner)).T
            row = index[(i * resolution + j) * resolution + k]
            candidate = jnp.sum((x - self.cloud.points[row]) ** 2, axis=-1)
            squared, nearest = jnp.minimum(squared, candidate), jnp.where(candidate < squared, row, nearest)
        offset = x - self.cloud.points[jax.lax.stop_gradient(nearest)]
        return jnp.where(self.cloud.count > 0, jnp.sum(offset**2, axis=-1), jnp.inf)


@jax.custom_jvp
def _nearest_squared_distance(x: Float[Array, "n 3"], points: Float[Array, "m 3"], mask: Bool[Array, " m"]):
    def closer(best, _, value):
        return jnp.minimum(best, value)

    best = _loop(x, points, mask, jnp.full(x.shape[0], jnp.inf, x.dtype), closer)
    return jnp.maximum(best + jnp.sum(x**2, axis=-1), 0.0)


@_nearest_squared_distance.defjvp
def _nearest_squared_distance_jvp(primals, tangents):
    x, points, mask = primals
    x_dot, points_dot, _ = tangents
    index = jax.lax.stop_gradient(_nearest_index(x, points, mask))
    offset = x - points[index]
    squared = jnp.where(jnp.any(mask), jnp.sum(offset**2, axis=-1), jnp.inf)
    return squared, 2.0 * jnp.sum(offset * (x_dot - points_dot[index]), axis=-1)


def _nearest_index(x: Float[Array, "n 3"], points: Float[Array, "m 3"], mask: Bool[Array, " m"]) -> Int[Array, " n"]:
    def closer(best, row, value):
        distance, index = best
        return jnp.minimum(distance, value), jnp.where(value < distance, row, index)

    start = (jnp.full(x.shape[0], jnp.inf, x.dtype), jnp.zeros(x.shape[0], jnp.int32))
    return _loop(x, points, mask, start, closer)[1]


def _loop(x, points, mask, best, closer):
    """Apply `best = closer(best, row, value)` to each row up to the last filled row, and return `best`.

    For the point y of a row, `value` is |y|^2 - 2 x.y at each point x. It is |x - y|^2 minus |x|^2, so the nearest row
    has the least value. It is infinite for an empty row. Each iteration of the loop processes `_UNROLL` rows.
    """
    padding = -points.shape[0] % _UNROLL
    squared = jnp.where(mask, jnp.sum(points**2, axis=-1), jnp.inf)
    planes = jnp.concatenate([jnp.where(mask[:, None], -2.0 * points, 0.0), squared[:, None]], axis=-1)
    planes = jnp.pad(planes, ((0, padding), (0, 0)), constant_values=jnp.inf).reshape(-1, _UNROLL, 4)
    planes = planes.at[..., :3].set(jnp.where(jnp.isinf(planes[..., 3:]), 0.0, planes[..., :3]))
    num_rows = jnp.max(jnp.where(mask, jnp.arange(points.shape[0]) + 1, 0), initial=0)

    def body(block, best):
        rows = planes[block]
        for step in range(_UNROLL):
            a, b, c, offset = rows[step]
            best = closer(best, block * _UNROLL + step, x[:, 0] * a + (x[:, 1] * b + (x[:, 2] * c + offset)))
        return best

    return jax.lax.fori_loop(0, -(-num_rows // _UNROLL), body, best)
