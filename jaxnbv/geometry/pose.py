"""Poses, `look_at`, and points on a sphere. Angles are in radians, lengths in scene units."""

import math
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import (
    AnyArray,
    as_floats,
    check_batch,
    check_index,
    checked,
    is_traced,
    on_host,
    own_settings,
    require,
)

# A matrix counts as a rotation if no entry of |R R^T - I| exceeds `_MAX_ERROR`. Up to `_MAX_ROUNDING`, it counts as a
# rotation that was written to three digits, and is corrected.
_MAX_ERROR, _MAX_ROUNDING = 1e-3, 5e-3
# Signs that convert the axes of each convention to OpenCV's right, down and forward axis.
_CONVENTIONS = {"opencv": (1.0, 1.0, 1.0), "opengl": (1.0, -1.0, -1.0)}


class Pose(eqx.Module):
    """A rigid camera-to-scene transform, or a batch of them along leading axes.

    A point p of the camera's frame lies at `rotation @ p + position` in the scene. The columns of `rotation` are the
    camera's right, down and forward axes in scene coordinates.

    **Raises:** `ValueError` for other shapes, if the rotation is not orthonormal with determinant +1 (tolerance 1e-3),
    or if an entry is not finite. Under `jit` only shapes are checked.
    """

    rotation: Float[Array, "*batch 3 3"]
    position: Float[Array, "*batch 3"]

    def __init__(self, rotation: Float[AnyArray, "*batch 3 3"], position: Float[AnyArray, "*batch 3"]):
        rotation, position = as_floats(rotation, "the rotation"), as_floats(position, "the position")
        shapes = rotation.shape, position.shape
        require(
            shapes[0][-2:] == (3, 3) and shapes[1][-1:] == (3,) and shapes[0][:-2] == shapes[1][:-1],
            f"a pose needs a rotation (..., 3, 3) and a position (..., 3), got {shapes[0]} and {shapes[1]}",
        )
        if not is_traced(rotation, position):
            _check_rigid(np.asarray(rotation), np.asarray(position))
        self.rotation, self.position = rotation, position

    @classmethod
    @checked
    def from_matrix(cls, matrix: Float[AnyArray, "*batch 4 4"], convention: str = "opencv") -> "Pose":
        """Convert a camera-to-scene (or camera-to-world) matrix [[R, t], [0, 1]] to a pose.

        A rotation that was rounded to three digits is made orthonormal.

        - `convention`: "opencv" for cameras that look along +z with y down, or "opengl" (also used by Blender and NeRF)
          for cameras that look along -z with y up.

        **Raises:** `ValueError` for an unknown convention, a last row other than (0, 0, 0, 1), or an invalid pose.
        """
        axes = _axes(convention)
        matrices = as_floats(matrix, "the matrix of a pose")
        require(matrices.shape[-2:] == (4, 4), f"the matrix of a pose has shape {matrices.shape}; give (..., 4, 4)")
        rotation: AnyArray = matrices[..., :3, :3]
        position: AnyArray = matrices[..., :3, 3]
        if not is_traced(matrices):
            # This uses NumPy, since JAX would compile a program for each operation.
            numbers = np.asarray(matrices)
            last, rotation, position = numbers[..., 3, :], numbers[..., :3, :3], numbers[..., :3, 3]
            require(
                bool(np.all(np.abs(last - [0.0, 0.0, 0.0, 1.0]) < 1e-6)),
                f"the last row of a pose's matrix is {last}, not (0, 0, 0, 1): give camera-to-world, not its transpose "
                "or a projection",
            )
            is_rounded = ((error := _rotation_error(rotation)) > _MAX_ERROR) & (error <= _MAX_ROUNDING)
            if is_rounded.any():
                rotation = np.where(is_rounded[..., None, None], _nearest_rotation(rotation), rotation)
        return cls(jnp.asarray(rotation * axes.astype(matrices.dtype)), jnp.asarray(position))

    @property
    def matrix(self) -> Float[Array, "*batch 4 4"]:
        """The camera-to-scene matrix [[R, t], [0, 1]] in OpenCV's convention."""
        return self.to_matrix()

    @own_settings()
    def to_matrix(self, convention: str = "opencv") -> Float[Array, "*batch 4 4"]:
        """Return the camera-to-scene matrix in the "opencv" or "opengl" convention, see `from_matrix`.

        **Raises:** `ValueError` for an unknown convention.
        """
        pose = on_host(self)
        xp = jnp if is_traced(self) else np
        rotation = pose.rotation * _axes(convention).astype(pose.rotation.dtype)
        last = xp.broadcast_to(np.array([0.0, 0.0, 0.0, 1.0], rotation.dtype), (*pose.position.shape[:-1], 1, 4))
        rows = xp.concatenate([rotation, pose.position[..., None]], axis=-1)
        return jnp.asarray(xp.concatenate([rows, last], axis=-2))

    @property
    @own_settings()
    def forward(self) -> Float[Array, "*batch 3"]:
        """The unit viewing direction in scene coordinates."""
        return self.rotation[..., :, 2]

    @own_settings()
    def to_scene(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """Convert points from the camera's frame to scene coordinates. The pose must not be a batch."""
        return jnp.matmul(points, self.rotation.T, precision="highest") + self.position

    @own_settings()
    def __getitem__(self, index) -> "Pose":
        """Return the pose, or the batch of poses, at an index of the leading axes.

        **Raises:** `ValueError` for a single pose, or if the index is out of range.
        """
        check_index(index, self.position.shape[:-1], "the pose")
        return jax.tree.map(lambda leaf: leaf[index], self)

    def __iter__(self) -> Iterator["Pose"]:
        """Iterate over the poses along the first axis of a batch."""
        check_batch(self.position.shape[:-1], "the pose")
        return (self[index] for index in range(self.position.shape[0]))


def _axes(convention: str) -> np.ndarray:
    require(convention in _CONVENTIONS, f"the convention is {convention!r}; give one of {', '.join(_CONVENTIONS)}")
    return np.array(_CONVENTIONS[convention])


def rigid_matrices(
    matrices: Float[np.ndarray, "n 4 4"],
) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"]]:
    """Return the matrices [[R, t], [0, 1]] with R made orthonormal, and whether each is a rigid motion.

    R may be a rotation that was rounded to three digits. A matrix that is no rigid motion is returned unchanged.
    """
    is_rigid = np.isfinite(matrices).all(axis=(1, 2)) & (_rotation_error(matrices[:, :3, :3]) <= _MAX_ROUNDING)
    is_rigid &= (np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]) < 1e-6).all(axis=1)
    rigid = np.array(matrices)
    rigid[is_rigid, :3, :3] = _nearest_rotation(matrices[is_rigid, :3, :3])
    return rigid, is_rigid


def _rotation_error(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n"]:
    """Return the largest entry of |R R^T - I| for each matrix R; infinite if R reflects or is not finite."""
    finite = np.where(np.isfinite(rotation).all(axis=(-1, -2), keepdims=True), rotation, 0.0)
    error = np.abs(finite @ np.swapaxes(finite, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    return np.where(np.linalg.det(finite) > 0, error, np.inf)


def _nearest_rotation(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Return the rotation nearest to each matrix in the Frobenius norm (orthogonal Procrustes)."""
    left, _, right = np.linalg.svd(rotation)
    return left @ right


def _check_rigid(rotation: np.ndarray, position: np.ndarray) -> None:
    finite = np.isfinite(rotation).all() and np.isfinite(position).all()
    require(finite, f"the pose has entries that are not finite: rotation {rotation}, position {position}; give numbers")
    error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3)).max(initial=0.0)
    require(
        bool((_rotation_error(rotation) < _MAX_ERROR).all()),
        f"the pose's 3 x 3 matrix is not a rotation: |R R^T - I| is {error:.3g} and det R is {np.linalg.det(rotation)}"
        "; build it with look_at, or orthonormalise it first",
    )


@own_settings()
def look_at(position, target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0)) -> Pose:
    """Return the pose at `position` whose forward axis points to `target`, in scene coordinates.

    - `position`, `target`: (*batch, 3) and (3,).
    - `up`: the direction that is up in the image, (3,). If the camera looks along `up`, it is replaced by the
      coordinate axis along which `up` has its smallest component.

    **Raises:** `ValueError` for other shapes, entries that are not finite, equal `position` and `target`, or zero `up`.
    """
    position, target, up = (
        as_floats(value, f"look_at's {name}")
        for value, name in ((position, "position"), (target, "target"), (up, "up"))
    )
    require(
        position.shape[-1:] == target.shape == up.shape == (3,),
        f"look_at needs a position (..., 3), a target (3,) and an up (3,), got {position.shape}, {target.shape}, "
        f"{up.shape}",
    )
    rotation, distance, length = _look_rotation(position, target, up)
    if not is_traced(position, target, up):
        for value, name in ((position, "position"), (target, "target"), (up, "up")):
            require(bool(np.isfinite(value).all()), f"look_at needs finite coordinates, got {name} {value}")
        require(
            bool(np.isfinite(distance).all()),
            f"look_at needs a position whose distance from its target is a finite number, got position {position}",
        )
        require(
            bool((np.asarray(distance) > 0).all()),
            f"look_at needs a position apart from its target; both are {target}",
        )
        require(
            0 < float(length) < math.inf,
            f"look_at needs an up direction with a finite length above zero, such as (0, 1, 0), got {up}",
        )
    return Pose(rotation, position)


@jax.jit
def _look_rotation(
    position: Float[Array, "*batch 3"], target: Float[Array, "3"], up: Float[Array, "3"]
) -> tuple[Float[Array, "*batch 3 3"], Float[Array, "*batch 1"], Float[Array, ""]]:
    """Return the rotation of `look_at`, the distance to the target, and the length of `up`."""
    offset, length = target - position, jnp.linalg.norm(up)
    distance = jnp.linalg.norm(offset, axis=-1, keepdims=True)
    forward = offset / distance
    fallback = jnp.eye(3, dtype=up.dtype)[jnp.argmin(jnp.abs(up))]
    is_parallel = jnp.linalg.norm(jnp.cross(forward, up), axis=-1, keepdims=True) < 1e-4 * length
    right = jnp.cross(forward, jnp.where(is_parallel, fallback, up))
    right = right / jnp.linalg.norm(right, axis=-1, keepdims=True)
    return jnp.stack([right, jnp.cross(forward, right), forward], axis=-1), distance, length


@checked
def fibonacci_sphere(count: int, radius: float = 1.0, min_elevation: float = -0.5 * math.pi) -> Float[Array, "count 3"]:
    """Return `count` almost evenly spaced points on a sphere, the Fibonacci lattice (Gonzalez 2010).

    - `min_elevation`: least angle of a point above the plane y = 0, in radians. The default is the whole sphere.

    **Raises:** `ValueError` if `count` < 1, `radius` <= 0 or the elevation is not within [-pi/2, pi/2).
    """
    require(count >= 1, f"a Fibonacci sphere needs at least one point, got {count}")
    require(radius > 0, f"the radius of the sphere must be positive, got {radius}")
    require(
        -0.5 * math.pi <= min_elevation < 0.5 * math.pi,
        f"the least elevation is {min_elevation} rad; it must lie within [-pi/2, pi/2)",
    )
    index = np.arange(count)
    y = 1.0 - (1.0 - math.sin(min_elevation)) * (index + 0.5) / count
    azimuth = index * math.pi * (3.0 - math.sqrt(5.0))
    ring = np.sqrt(1.0 - y**2)
    points = np.stack([ring * np.cos(azimuth), y, ring * np.sin(azimuth)], axis=-1)
    return jnp.asarray(radius * points, dtype=jnp.result_type(float))
