"""What has been seen: the points that are kept, where they were seen from, and the space that was seen empty."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import check_type
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning.grid import Grid

# A model takes a hundred or two of the empty points, and the time to choose them grows with how many there are.
_POINTS_ALONG_AXIS = 20


class EmptyPoints(NamedTuple):
    """Points (scene coordinates) that were seen to be empty. Rows whose mask is False hold nothing."""

    points: Float[Array, "m 3"]
    mask: Bool[Array, " m"]


class Observations(eqx.Module):
    """What has been seen, in scene coordinates. Immutable and of fixed shapes, so that nothing recompiles as it grows.

    - `cloud`: D, the points that are kept.
    - `poses`: the views taken in the first `num_views` rows; the others hold the identity.
    - `seen_empty`: the nodes of `grid` that a scan has shown to be empty; both are None where that is not kept.
    """

    cloud: PointCloud
    poses: Pose
    num_views: Int[Array, ""]
    seen_empty: Bool[Array, "g g g"] | None = None
    grid: Grid | None = None

    @classmethod
    def of(cls, seen: "Observations | PointCloud") -> "Observations":
        """Observations as it is; a cloud alone as observations of no known pose.

        **Raises:** `ValueError` for anything else.
        """
        check_type(seen, Observations | PointCloud, "the observations")
        return seen if isinstance(seen, Observations) else cls.before_views(seen, 0, None)

    @classmethod
    def before_views(cls, cloud: PointCloud, max_views: int, grid: Grid | None) -> "Observations":
        """D before any pose is known, with room for so many views.

        - `grid`: on whose nodes empty space is kept; None where it is not.
        """
        dtype = jnp.result_type(float)
        poses = Pose(np.tile(np.eye(3, dtype=dtype), (max_views, 1, 1)), np.zeros((max_views, 3), dtype))
        empty = None if grid is None else jnp.zeros((grid.resolution,) * 3, bool)
        return cls(cloud, poses, jnp.asarray(0, jnp.int32), empty, grid)

    @property
    def max_views(self) -> int:
        """How many views there is room for."""
        return self.poses.position.shape[0]

    @property
    def last_pose(self) -> Pose:
        """The pose of the last view; the identity where there is none."""
        return jax.tree.map(lambda rows: rows[self.num_views - 1], self.poses)

    @property
    def empty_points(self) -> EmptyPoints:
        """The nodes seen empty, of every few along each axis, for a model to condition on."""
        if self.seen_empty is None or self.grid is None:
            return EmptyPoints(jnp.zeros((1, 3), self.cloud.points.dtype), jnp.zeros(1, bool))
        stride = -(-self.grid.resolution // _POINTS_ALONG_AXIS)
        axis = jnp.asarray(self.grid.axis, jnp.result_type(float))[::stride]
        nodes = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return EmptyPoints(nodes, self.seen_empty[::stride, ::stride, ::stride].reshape(-1))

    def with_visited(self, poses: Sequence[Pose]) -> "Observations":
        """The same, with these poses taken for visited too. It has room for twice as many, so that its shapes do not
        depend on how many they are."""
        room, count = jax.tree.map(lambda rows: jnp.concatenate([rows, rows]), self.poses), self.num_views
        for pose in poses:
            room, count = jax.tree.map(lambda rows, row, at=count: rows.at[at].set(row), room, pose), count + 1
        return dataclasses.replace(self, poses=room, num_views=count)
