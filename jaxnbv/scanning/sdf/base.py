"""The base class of signed distance functions, rigid motions, scaling and set operations (constructive solid geometry).

A signed distance function is negative inside the solid. All functions here have slopes of at most one, so their
magnitude never exceeds the distance to the surface, and a ray may stride by it (Hart 1996). Each class states whether
it is *exact* or a *bound* if its parts are exact. Parameters are arrays: build a batch of scenes with `jax.vmap` and
scan them in one jitted function.
"""

import functools
from abc import abstractmethod
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.checks import AnyArray, InputError, as_floats, check_type, is_traced, require, takes_native
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.rotations import rotation_about, safe_norm

# A converter accepts numbers and lists, which mypy cannot see.
if TYPE_CHECKING:
    Scalar: TypeAlias = Any
    Vector: TypeAlias = Any
    Matrix: TypeAlias = Any
else:
    Scalar, Vector, Matrix = Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]


def _as_float(value):
    return as_floats(value, "a parameter of a signed distance")


def parameter(**kwargs):
    """A field for a parameter of a signed distance."""
    return eqx.field(converter=_as_float, **kwargs)


def nonnegative(**kwargs):
    """A field for a parameter that must not be negative."""
    return parameter(metadata={"length": True}, **kwargs)


def split(x):
    """The three coordinates of points (..., 3)."""
    return x[..., 0], x[..., 1], x[..., 2]


# Not jnp.minimum and jnp.maximum, whose derivatives split ties evenly and cost many times as much.
def least(a, b):
    """The smaller of two values, the first of equals."""
    return jnp.where(a <= b, a, b)


def greatest(a, b):
    """The larger of two values, the first of equals."""
    return jnp.where(a >= b, a, b)


@jax.custom_jvp
def least_of_last(values):
    """The minimum along the last axis, with the derivative of its first occurrence.

    The derivative of `jnp.min` compares the values with their minimum. If both are compiled separately they can differ
    in the last bit, and the derivative is then 0 / 0.
    """
    return jnp.min(values, axis=-1)


@least_of_last.defjvp
def _least_of_last_jvp(values, tangents):
    (values,), (tangents,) = values, tangents
    is_least = jnp.arange(values.shape[-1]) == jnp.argmin(values, axis=-1, keepdims=True)
    return least_of_last(values), jnp.sum(jnp.where(is_least, tangents, 0.0), axis=-1)


def corner_distance(*q):
    """Signed distance to the solid where all q <= 0, from the signed distances q to orthogonal planes."""
    outside = safe_norm(*(greatest(c, 0.0) for c in q))
    return outside + least(functools.reduce(greatest, q), 0.0)


class SignedDistance(eqx.Module):
    """A solid, defined by its signed distance function in scene units: negative inside.

    A subclass defines `__call__`, which treats each point independently, has slopes of at most one, and changes sign at
    the surface. Solids combine as sets: `a | b`, `a & b`, `a - b`.

    **Raises:** `ValueError` if a parameter is not finite, has the wrong shape, or is a negative length.
    """

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        for name in {"__call__", "part_labels"} & vars(cls).keys():
            setattr(cls, name, takes_native(vars(cls)[name]))

    @abstractmethod
    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """The signed distance at the points x."""

    @property
    def class_label(self) -> Int[AnyArray, ""] | None:
        """See `Surface.class_label`."""
        return None

    def part_labels(self, x: Float[AnyArray, "*n 3"]) -> Int[Array, "*n"] | None:
        """See `Surface.part_labels`."""
        return None

    def __check_init__(self):
        for field in fields(self):
            value, name = getattr(self, field.name), f"{type(self).__name__}.{field.name}"
            if field.type is SignedDistance:
                check_type(value, SignedDistance, name)
            if not eqx.is_array(value):
                continue
            # A letter in the annotation allows any length.
            shape = tuple(int(n) if n.isdigit() else n for n in cast(Any, field.type).dim_str.split())
            require(
                len(value.shape) == len(shape)
                and all(isinstance(n, str) or n == size for n, size in zip(shape, value.shape, strict=True)),
                f"{name} has shape {value.shape}, not {shape}: for a batch of solids build it inside jax.vmap",
            )
            if not is_traced(value):
                numbers = np.asarray(value)
                # Not `require`, since formatting an array takes far longer than checking it.
                if not np.isfinite(numbers).all():
                    raise InputError(f"{name} is {value}: give finite numbers")
                if "length" in field.metadata and (numbers < 0).any():
                    raise InputError(f"{name} is {value}: a length must not be negative")

    def translate(self, offset) -> "Translated":
        """The solid moved by `offset` (3,)."""
        return Translated(self, offset)

    def rotate(self, axis, angle) -> "Rotated":
        """The solid turned about the axis (3,) through the origin by `angle` radians, right-handed.

        **Raises:** `ValueError` if the axis is zero.
        """
        axis, angle = _as_float(axis), _as_float(angle)
        shapes = axis.shape, angle.shape
        require(shapes == ((3,), ()), f"axis and angle have shapes {shapes[0]} and {shapes[1]}: give (3,) and ()")
        if not is_traced(axis):
            # In JAX's float type, which flushes numbers below the least normal one to zero.
            longer = bool(np.sum(np.square(np.asarray(axis))) >= jnp.finfo(axis.dtype).tiny)
            require(longer, f"the axis of rotation is {axis}: give a direction that is not zero")
        return Rotated(self, rotation_about(axis, angle))

    def scale(self, factor) -> "Scaled":
        """The solid scaled about the origin by a positive factor."""
        return Scaled(self, factor)

    def __or__(self, other: "SignedDistance") -> "Union":
        return Union(self, other)

    def __and__(self, other: "SignedDistance") -> "Intersection":
        return Intersection(self, other)

    def __sub__(self, other: "SignedDistance") -> "Difference":
        return Difference(self, other)


class Union(SignedDistance):
    """The union, min(a, b). Exact outside, a bound inside."""

    first: SignedDistance
    second: SignedDistance

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return least(self.first(x), self.second(x))


class SmoothUnion(SignedDistance):
    """The union with a fillet where the two surfaces come within `width` of each other. A bound.

    min(a, b) - h^2 / (4 width), h = max(width - |a - b|, 0). Its slopes are averages of those of a and b.
    """

    first: SignedDistance
    second: SignedDistance
    width: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        a, b = self.first(x), self.second(x)
        overlap = greatest(self.width - jnp.abs(a - b), 0.0)
        return least(a, b) - overlap**2 / jnp.where(self.width > 0, 4.0 * self.width, 1.0)


class Intersection(SignedDistance):
    """The intersection, max(a, b). A bound outside, exact inside."""

    first: SignedDistance
    second: SignedDistance

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return greatest(self.first(x), self.second(x))


class Difference(SignedDistance):
    """The first solid without the second, max(a, -b). A bound outside, exact inside."""

    first: SignedDistance
    second: SignedDistance

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return greatest(self.first(x), -self.second(x))


class Translated(SignedDistance):
    """A solid moved by `offset`. As exact as the solid."""

    solid: SignedDistance
    offset: Vector = parameter()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.solid(x - self.offset)


class Rotated(SignedDistance):
    """A solid turned by a rotation matrix about the origin. As exact as the solid.

    **Raises:** `ValueError` also if the matrix is not a rotation.
    """

    solid: SignedDistance
    rotation: Matrix = parameter()

    def __check_init__(self):
        Pose(self.rotation, np.zeros(3))

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        # R^T x as a sum, which XLA fuses with other operations; a matrix product would not fuse.
        a, b, c = (x[..., i, None] * self.rotation[i] for i in range(3))
        return self.solid(a + b + c)


class Scaled(SignedDistance):
    """A solid scaled about the origin by `factor` > 0. As exact as the solid."""

    solid: SignedDistance
    factor: Scalar = nonnegative()

    def __check_init__(self):
        if not is_traced(self.factor):
            require(bool(self.factor > 0), f"a solid cannot be scaled by {self.factor}: give a positive factor")

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.factor * self.solid(x / self.factor)
