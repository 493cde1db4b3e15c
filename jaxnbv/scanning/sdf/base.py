"""The base class of solids, rigid motions, scaling, and set operations (constructive solid geometry).

A solid is defined by a signed distance function, which is negative inside. All functions here have slopes of at most
one, so their magnitude never exceeds the distance to the surface, and a ray may advance by it (Hart 1996). Each class
says whether its magnitude equals this distance (*exact*) or is a *lower bound* on it, provided that the solids that it
combines are exact. Parameters are arrays, so `jax.vmap` can build a batch of solids that one compiled program scans.
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

# Fields of these types also accept numbers and lists, which a converter turns into arrays. mypy does not know this.
if TYPE_CHECKING:
    Scalar: TypeAlias = Any
    Vector: TypeAlias = Any
    Matrix: TypeAlias = Any
else:
    Scalar, Vector, Matrix = Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]


def _as_float(value):
    return as_floats(value, "a parameter of a signed distance")


def parameter(**kwargs):
    """Return a dataclass field for a parameter of a solid. Numbers and lists are converted to arrays."""
    return eqx.field(converter=_as_float, **kwargs)


def nonnegative(**kwargs):
    """Return a dataclass field for a parameter of a solid that must not be negative."""
    return parameter(metadata={"length": True}, **kwargs)


def split(x):
    """Return the three coordinates of points (..., 3) as three arrays."""
    return x[..., 0], x[..., 1], x[..., 2]


# `least` and `greatest` replace jnp.minimum and jnp.maximum, whose derivatives split ties evenly and cost many times as
# much.
def least(a, b):
    """Return the smaller of two values. If they are equal, the derivative is that of `a`."""
    return jnp.where(a <= b, a, b)


def greatest(a, b):
    """Return the larger of two values. If they are equal, the derivative is that of `a`."""
    return jnp.where(a >= b, a, b)


@jax.custom_jvp
def least_of_last(values):
    """Return the minimum along the last axis. Its derivative is that of the first smallest entry.

    The derivative of `jnp.min` divides by the number of values that equal the minimum. If values and minimum are
    compiled separately, all can differ from it in the last bit, and the derivative is then 0 / 0.
    """
    return jnp.min(values, axis=-1)


@least_of_last.defjvp
def _least_of_last_jvp(values, tangents):
    (values,), (tangents,) = values, tangents
    is_least = jnp.arange(values.shape[-1]) == jnp.argmin(values, axis=-1, keepdims=True)
    return least_of_last(values), jnp.sum(jnp.where(is_least, tangents, 0.0), axis=-1)


def corner_distance(*q):
    """Return the signed distance to the solid behind orthogonal planes, given the signed distance to each."""
    outside = safe_norm(*(greatest(c, 0.0) for c in q))
    return outside + least(functools.reduce(greatest, q), 0.0)


class SignedDistance(eqx.Module):
    """A solid, defined by its signed distance function in scene units: negative inside.

    A subclass defines `__call__`, which evaluates each point independently, has slopes of at most one, and changes sign
    at the surface. Solids can be combined as sets: `a | b`, `a & b` and `a - b`.

    **Raises:** `ValueError` if a parameter is not finite, has the wrong shape, or is a negative length.
    """

    def __init_subclass__(cls, **settings: Any):
        super().__init_subclass__(**settings)
        for name in {"__call__", "part_labels"} & vars(cls).keys():
            setattr(cls, name, takes_native(vars(cls)[name]))

    @abstractmethod
    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        """Return the signed distance at the points x."""

    @property
    def class_label(self) -> Int[AnyArray, ""] | None:
        """Index of the object's class; None if the object has no class."""
        return None

    def part_labels(self, x: Float[AnyArray, "*n 3"]) -> Int[Array, "*n"] | None:
        """Return the index of the part that each surface point x belongs to; None without parts."""
        return None

    def __check_init__(self):
        for field in fields(self):
            value, name = getattr(self, field.name), f"{type(self).__name__}.{field.name}"
            if field.type is SignedDistance:
                check_type(value, SignedDistance, name)
            if not eqx.is_array(value):
                continue
            # A letter in the shape annotation allows any length of the axis.
            shape = tuple(int(n) if n.isdigit() else n for n in cast(Any, field.type).dim_str.split())
            require(
                len(value.shape) == len(shape)
                and all(isinstance(n, str) or n == size for n, size in zip(shape, value.shape, strict=True)),
                f"{name} has shape {value.shape}, not {shape}: for a batch of solids build it inside jax.vmap",
            )
            if not is_traced(value):
                numbers = np.asarray(value)
                # `require` would format the array even if it is valid, which takes far longer than checking it.
                if not np.isfinite(numbers).all():
                    raise InputError(f"{name} is {value}: give finite numbers")
                if "length" in field.metadata and (numbers < 0).any():
                    raise InputError(f"{name} is {value}: a length must not be negative")

    def translate(self, offset) -> "Translated":
        """Return the solid moved by `offset` (3,)."""
        return Translated(self, offset)

    def rotate(self, axis, angle) -> "Rotated":
        """Return the solid rotated about `axis` (3,) through the origin by `angle` radians, right-handed.

        **Raises:** `ValueError` if the axis is zero, or an argument has the wrong shape.
        """
        axis, angle = _as_float(axis), _as_float(angle)
        shapes = axis.shape, angle.shape
        require(shapes == ((3,), ()), f"axis and angle have shapes {shapes[0]} and {shapes[1]}: give (3,) and ()")
        if not is_traced(axis):
            # JAX flushes numbers below the least normal number of its float type to zero.
            longer = bool(np.sum(np.square(np.asarray(axis))) >= jnp.finfo(axis.dtype).tiny)
            require(longer, f"the axis of rotation is {axis}: give a direction that is not zero")
        return Rotated(self, rotation_about(axis, angle))

    def scale(self, factor) -> "Scaled":
        """Return the solid scaled about the origin by a positive factor."""
        return Scaled(self, factor)

    def __or__(self, other: "SignedDistance") -> "Union":
        return Union(self, other)

    def __and__(self, other: "SignedDistance") -> "Intersection":
        return Intersection(self, other)

    def __sub__(self, other: "SignedDistance") -> "Difference":
        return Difference(self, other)


class Union(SignedDistance):
    """The union of two solids. The smaller of their distances is exact outside, else a lower bound."""

    first: SignedDistance
    second: SignedDistance

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return least(self.first(x), self.second(x))


class SmoothUnion(SignedDistance):
    """The union of two solids with a fillet where their distances a and b differ by less than `width`.

    The distance is min(a, b) - h^2 / (4 width) with h = max(width - |a - b|, 0). It is a lower bound.
    """

    first: SignedDistance
    second: SignedDistance
    width: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        a, b = self.first(x), self.second(x)
        overlap = greatest(self.width - jnp.abs(a - b), 0.0)
        return least(a, b) - overlap**2 / jnp.where(self.width > 0, 4.0 * self.width, 1.0)


class Intersection(SignedDistance):
    """The intersection of two solids. The larger of their distances is exact inside, else a lower bound."""

    first: SignedDistance
    second: SignedDistance

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return greatest(self.first(x), self.second(x))


class Difference(SignedDistance):
    """The first solid without the second. max(first, -second) is exact inside, else a lower bound."""

    first: SignedDistance
    second: SignedDistance

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return greatest(self.first(x), -self.second(x))


class Translated(SignedDistance):
    """A solid moved by `offset`. The distance is exact if the distance of `solid` is exact."""

    solid: SignedDistance
    offset: Vector = parameter()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.solid(x - self.offset)


class Rotated(SignedDistance):
    """A solid rotated about the origin by a matrix.

    The distance is exact if `solid` has an exact distance.

    **Raises:** `ValueError` if the matrix is not a rotation, or for the same reasons as `SignedDistance`.
    """

    solid: SignedDistance
    rotation: Matrix = parameter()

    def __check_init__(self):
        Pose(self.rotation, np.zeros(3))

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        # This is R^T x. XLA fuses the sum with other operations, but would not fuse a matrix product.
        a, b, c = (x[..., i, None] * self.rotation[i] for i in range(3))
        return self.solid(a + b + c)


class Scaled(SignedDistance):
    """A solid scaled about the origin by `factor`. The distance is exact if `solid` has an exact distance.

    **Raises:** `ValueError` if the factor is not positive.
    """

    solid: SignedDistance
    factor: Scalar = nonnegative()

    def __check_init__(self):
        if not is_traced(self.factor):
            require(bool(self.factor > 0), f"a solid cannot be scaled by {self.factor}: give a positive factor")

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.factor * self.solid(x / self.factor)
