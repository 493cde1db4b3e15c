"""Placements of parts that rest on a table: stable poses, rotated about the vertical."""

from typing import cast

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxnbv.checks import AnyArray, require
from jaxnbv.surfaces.placement import ShapePoses
from jaxnbv.surfaces.shape_bank import ShapeBank

# Largest number of stable poses per part. Poses whose upward directions differ by less than this angle (radians) count
# as equal.
_MAX_POSES, _MIN_ANGLE = 8, np.radians(10.0)
_NODES = 32
# Rotation from trimesh's upward axis z to y.
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class Resting(ShapePoses):
    """Placements of parts that rest on a table: a stable pose, rotated by any angle about the vertical y.

    Searches start from such placements, but refinement may tilt parts.

    - `stable`: (k, p, 3, 3) rotations of each part of a bank to its stable poses, the most likely pose first.
    """

    stable: Float[Array, "k p 3 3"]

    @classmethod
    def of(cls, bank: ShapeBank) -> "Resting":
        """Compute the stable poses of each part of a bank, treated as a solid of uniform density.

        A part rests on a face of its convex hull.

        **Raises:** `ValueError` for an empty bank.
        """
        require(len(bank) > 0, "the bank is empty: give one with parts")
        poses_of_parts = [_stable_poses(bank, index) for index in range(len(bank))]
        num_poses = max(len(poses) for poses in poses_of_parts)
        # If a part has fewer poses than other parts, repeat its poses.
        rows = [poses[np.arange(num_poses) % len(poses)] for poses in poses_of_parts]
        return cls(jnp.asarray(np.stack(rows), jnp.result_type(float)))

    def rotations(self, count: int) -> Float[AnyArray, "m 3 3"]:
        """Return the start rotations of the first part. Other parts rest differently, see `rotations_of`."""
        return self.rotations_of(1, count)[0]

    def rotations_of(self, num_shapes: int, count: int) -> Float[AnyArray, "k m 3 3"]:
        """Return, for each part, its stable poses rotated by evenly spaced angles about the vertical."""
        stable = self.stable[:num_shapes]
        num_angles = max(1, count // stable.shape[1])
        angles = 2.0 * np.pi * np.arange(num_angles) / num_angles
        rotations = Rotation.from_rotvec(angles[:, None] * np.array([0.0, 1.0, 0.0])).as_matrix()
        starts = jnp.einsum("tij,kpjl->kptil", jnp.asarray(rotations, stable.dtype), stable, precision="highest")
        return starts.reshape(len(stable), -1, 3, 3)

    def rotation_axes(self) -> Float[np.ndarray, "3 k"]:
        return np.eye(3)


def _stable_poses(bank: ShapeBank, index: int) -> Float[np.ndarray, "p 3 3"]:
    shape = bank.shape(jnp.asarray(index))
    points = np.asarray(shape.extremes, np.float64)
    axes = [np.linspace(low, high, _NODES) for low, high in zip(points.min(axis=0), points.max(axis=0), strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = nodes[np.asarray(shape.solid(jnp.asarray(nodes, shape.extremes.dtype))) < 0]
    center = inside.mean(axis=0) if len(inside) else points.mean(axis=0)
    hull = cast(trimesh.Trimesh, trimesh.convex.convex_hull(points))
    transforms, probabilities = trimesh.poses.compute_stable_poses(hull, center_mass=center)
    rotations: list[np.ndarray] = []
    for transform in transforms[np.argsort(-probabilities)]:
        rotation = _UPRIGHT @ transform[:3, :3]
        # Poses that differ only by a rotation about the vertical have the same upward direction in the part's frame.
        if all(rotation[1] @ other[1] < np.cos(_MIN_ANGLE) for other in rotations):
            rotations.append(rotation)
    return np.stack(rotations[:_MAX_POSES]) if rotations else np.eye(3)[None]
