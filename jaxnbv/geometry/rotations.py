"""Rotations, and lengths and directions of vectors whose derivatives at the zero vector are finite."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray


@jax.custom_jvp
def safe_norm(*components: Float[AnyArray, "*#n"]) -> Float[Array, "*n"]:
    """Return the lengths of vectors, whose components are separate arrays. The derivative at zero is zero."""
    return jnp.sqrt(sum(c * c for c in components))


@safe_norm.defjvp
def _safe_norm_jvp(components, tangents):
    length = safe_norm(*components)
    inverse = 1.0 / jnp.where(length > 0, length, 1.0)
    return length, sum(inverse * c * dc for c, dc in zip(components, tangents, strict=True))


@jax.jit
def rotation_about(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the right-handed rotation about an axis by an angle in radians; NaN if the axis is zero.

    For the unit axis k and the angle a, this is Rodrigues' formula cos(a) I + sin(a) [k]_x + (1 - cos(a)) k k^T, where
    [k]_x is the matrix of the cross product with k.
    """
    unit = axis / safe_norm(*axis)
    return jnp.cos(angle) * jnp.eye(3) + jnp.sin(angle) * _cross(unit) + (1.0 - jnp.cos(angle)) * unit[:, None] * unit


def rotation_from_vector(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Convert a rotation vector w, with the angle a = |w| in radians, to a matrix (Rodrigues' formula).

    The matrix is I + sin(a) / a [w]_x + (1 - cos(a)) / a^2 [w]_x^2. Near zero, both fractions are replaced by their
    Taylor series, so the result is differentiable at w = 0 too.
    """
    square = jnp.sum(vector**2)
    is_small = square < 1e-12
    angle = jnp.sqrt(jnp.where(is_small, 1.0, square))
    sine = jnp.where(is_small, 1.0 - square / 6.0, jnp.sin(angle) / angle)
    versine = jnp.where(is_small, 0.5 - square / 24.0, (1.0 - jnp.cos(angle)) / angle**2)
    cross = _cross(vector)
    return jnp.eye(3) + sine * cross + versine * jnp.matmul(cross, cross, precision="highest")


def _cross(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the matrix [v]_x for which [v]_x u = v x u."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


@jax.jit
def rotation_to_6d(rotation: Float[AnyArray, "*batch 3 3"]) -> Float[Array, "*batch 6"]:
    """Return the first two columns of a rotation, the 6-D representation of Zhou et al. (2019)."""
    rotation = jnp.asarray(rotation)
    return jnp.concatenate([rotation[..., :, 0], rotation[..., :, 1]], axis=-1)


@jax.jit
def rotation_from_6d(columns: Float[AnyArray, "*batch 6"]) -> Float[Array, "*batch 3 3"]:
    """Return the rotation for a pair of vectors (a, b), the 6-D representation of Zhou et al. (2019).

    The columns of the rotation are c_1 = a / |a|;  c_2 = b - (c_1 . b) c_1, normalised;  c_3 = c_1 x c_2. Every pair
    gives a rotation. If a is zero, the x axis replaces a. If b is zero or parallel to a, a coordinate axis replaces b.
    """
    columns = jnp.asarray(columns, dtype=jnp.result_type(float))
    first = normalise(columns[..., :3], jnp.asarray([1.0, 0.0, 0.0], columns.dtype))
    fallback = _any_orthogonal(first)
    second = normalise(_reject(normalise(columns[..., 3:], fallback), first), fallback, _rounding(columns))
    # For nearly parallel vectors, the difference has lost digits and is not orthogonal to `first`. A second projection
    # corrects this.
    second = normalise(_reject(second, first), fallback)
    return jnp.stack([first, second, jnp.cross(first, second)], axis=-1)


@jax.jit
def rotation_between(
    start: Float[AnyArray, "*batch 3"], end: Float[AnyArray, "*batch 3"]
) -> Float[Array, "*batch 3 3"]:
    """Return the smallest rotation from unit vector `start` to `end`, or one of many if they are opposite."""
    start, end = jnp.asarray(start), jnp.asarray(end)
    halfway = normalise(start + end, _any_orthogonal(start), _rounding(start))
    # The sum of nearly opposite vectors has lost digits, but their difference has not. The exact sum is orthogonal to
    # the difference, so the part of the sum along the difference is removed.
    is_opposed = jnp.sum(start * end, axis=-1, keepdims=True) < 0
    difference = normalise(jnp.where(is_opposed, start - end, 0.0), jnp.zeros_like(start))
    halfway = normalise(_reject(halfway, difference), halfway)
    return jnp.matmul(_reflection(halfway), _reflection(start), precision="highest")


def _reflection(unit: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the reflection I - 2 u u^T, which reverses the direction of a unit vector u."""
    return jnp.eye(3, dtype=unit.dtype) - 2.0 * unit[..., :, None] * unit[..., None, :]


def normalise(
    vector: Float[Array, "*batch n"], fallback: Float[Array, "*#batch n"], min_length: float = 0.0
) -> Float[Array, "*batch n"]:
    """Return the unit vector along a vector, or `fallback` if the vector is too short.

    A vector is long enough if the magnitude of its largest entry exceeds `min_length` and the smallest normal float.
    """
    # The vector is divided by its largest entry, so that no square overflows.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1, keepdims=True))
    is_usable = largest > max(min_length, float(jnp.finfo(vector.dtype).tiny))
    vector = vector / jnp.where(is_usable, largest, 1.0)
    square = jnp.where(is_usable, jnp.sum(vector**2, axis=-1, keepdims=True), 1.0)
    return jnp.where(is_usable, vector / jnp.sqrt(square), fallback)


def _rounding(unit: Float[Array, "*batch n"]) -> float:
    """Return the length below which the direction of a sum of unit vectors may be a rounding error."""
    return 16.0 * float(jnp.finfo(unit.dtype).eps)


def _reject(vector: Float[Array, "*batch 3"], unit: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Return the component of a vector that is orthogonal to a unit vector."""
    return vector - jnp.sum(vector * unit, axis=-1, keepdims=True) * unit


def _any_orthogonal(unit: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    axis = jnp.eye(3, dtype=unit.dtype)[jnp.argmin(jnp.abs(unit), axis=-1)]
    return normalise(_reject(axis, unit), axis)
