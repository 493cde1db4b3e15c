"""A list of poses in arrays of fixed size, so that JAX does not recompile programs as it grows."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.geometry.pose import Pose

# Two poses count as the same view if their positions (scene units) and viewing directions differ by less than this.
_MAX_DIFFERENCE = 1e-3


class PoseList(eqx.Module):
    """A list of poses in scene coordinates, with fixed capacity.

    - `rows`: a batch of poses. The first `count` poses are the list. The remaining rows are the identity.
    """

    rows: Pose
    count: Int[Array, ""]

    @classmethod
    def empty(cls, capacity: int) -> "PoseList":
        dtype = jnp.result_type(float)
        rows = Pose(np.tile(np.eye(3, dtype=dtype), (capacity, 1, 1)), np.zeros((capacity, 3), dtype))
        return cls(rows, jnp.asarray(0, jnp.int32))

    @property
    def capacity(self) -> int:
        """Largest number of poses that the list can hold."""
        return self.rows.position.shape[0]

    @property
    def last(self) -> Pose:
        """The last pose; the identity for an empty list."""
        return self.rows[self.count - 1]

    def append(self, pose: Pose) -> "PoseList":
        """Return a list with one more pose. A full list is returned unchanged."""
        rows = jax.tree.map(lambda rows, row: rows.at[self.count].set(row), self.rows, pose)
        return dataclasses.replace(self, rows=rows, count=jnp.minimum(self.count + 1, self.capacity))

    def contains(self, poses: Pose) -> Bool[Array, " poses"]:
        """Return, for each pose of a batch, whether the list contains the same view (see `is_same_view`)."""
        return jnp.any(is_same_view(poses[:, None], self.rows[None]) & self.is_filled, axis=1)

    def distance(self, poses: Pose) -> Float[Array, " poses"]:
        """Return each pose's distance to the nearest pose of the list; infinite if the list is empty."""
        distance = jnp.linalg.norm(poses.position[:, None] - self.rows.position[None], axis=-1)
        return jnp.min(jnp.where(self.is_filled, distance, jnp.inf), axis=1)

    @property
    def is_filled(self) -> Bool[Array, " capacity"]:
        """Whether each row holds a pose of the list."""
        return jnp.arange(self.capacity) < self.count


def is_same_view(poses: Pose, others: Pose) -> Bool[Array, "*batch"]:
    """Return whether poses (broadcast) agree to 1e-3 in position (scene units) and in viewing direction."""
    is_near = jnp.linalg.norm(poses.position - others.position, axis=-1) < _MAX_DIFFERENCE
    return is_near & (jnp.linalg.norm(poses.forward - others.forward, axis=-1) < _MAX_DIFFERENCE)
