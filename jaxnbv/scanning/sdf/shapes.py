"""Elementary solids with their signed distance functions."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray, is_traced, require
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.scanning.sdf.base import (
    Scalar,
    SignedDistance,
    Vector,
    corner_distance,
    greatest,
    nonnegative,
    parameter,
    split,
)


class Sphere(SignedDistance):
    """The ball of `radius` about the origin. The distance is exact."""

    radius: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return safe_norm(*split(x)) - self.radius


class Cuboid(SignedDistance):
    """The box [-half_size, half_size] with rounded edges. The distance is exact.

    - `rounding`: radius of the edges. It does not change the outer size.

    **Raises:** `ValueError` if the rounding exceeds half of a side, or for the same reasons as `SignedDistance`.
    """

    half_size: Vector = nonnegative()
    rounding: Scalar = nonnegative(default=0.0)

    def __check_init__(self):
        if not is_traced(self):
            require(
                bool((self.rounding <= self.half_size).all()),
                f"a box of half sizes {self.half_size} cannot be rounded by {self.rounding}: reduce the rounding",
            )

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return corner_distance(*split(jnp.abs(x) - (self.half_size - self.rounding))) - self.rounding


class Cylinder(SignedDistance):
    """The solid cylinder about the y axis, with flat caps at |y| = half_height. The distance is exact."""

    radius: Scalar = nonnegative()
    half_height: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        x, y, z = split(x)
        return corner_distance(safe_norm(x, z) - self.radius, jnp.abs(y) - self.half_height)


class Cone(SignedDistance):
    """The solid truncated cone about the y axis, with caps at |y| = half_height. The distance is exact.

    - `bottom_radius`, `top_radius`: radii of the lower and the upper cap; zero gives a tip.
    """

    bottom_radius: Scalar = nonnegative()
    top_radius: Scalar = nonnegative()
    half_height: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        # The profile in the half plane (r, y) has two caps, and a slanted edge from the bottom to the top corner.
        x, y, z = split(x)
        r = safe_norm(x, z)
        widening, rise = self.top_radius - self.bottom_radius, 2.0 * self.half_height
        slant = safe_norm(widening, rise)
        out, up = r - self.bottom_radius, y + self.half_height
        side = (rise * out - widening * up) / slant
        edge_position = (widening * out + rise * up) / slant
        cap = jnp.abs(y) - self.half_height
        inside = greatest(side, cap)
        bottom, top = safe_norm(out, up), safe_norm(r - self.top_radius, y - self.half_height)
        outside = jnp.where(edge_position < 0, bottom, jnp.where(edge_position > slant, top, inside))
        over_cap = (cap > 0) & (jnp.where(y > 0, r - self.top_radius, out) < 0)
        return jnp.where(over_cap, cap, jnp.where(inside > 0, outside, inside))


class Torus(SignedDistance):
    """A tube of `minor_radius` about a circle of `major_radius` around the y axis. The distance is exact."""

    major_radius: Scalar = nonnegative()
    minor_radius: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        x, y, z = split(x)
        return safe_norm(safe_norm(x, z) - self.major_radius, y) - self.minor_radius


class Capsule(SignedDistance):
    """All points within `radius` of the segment from `start` to `end`. The distance is exact."""

    start: Vector = parameter()
    end: Vector = parameter()
    radius: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        segment = self.end - self.start
        squared = jnp.sum(segment**2)
        offset = split(x - self.start)
        fraction = sum(c * d for c, d in zip(offset, segment, strict=True)) / jnp.where(squared > 0, squared, 1.0)
        nearest = jnp.clip(fraction, 0.0, 1.0)
        return safe_norm(*(c - nearest * d for c, d in zip(offset, segment, strict=True))) - self.radius


class HalfSpace(SignedDistance):
    """The half space behind a plane through `point`, such as a table or a wall. The distance is exact.

    - `normal`: normal of the plane, of any length, which points out of the solid.

    **Raises:** `ValueError` if the normal is zero, or for the same reasons as `SignedDistance`.
    """

    point: Vector = parameter()
    normal: Vector = parameter()

    def __check_init__(self):
        if not is_traced(self.normal):
            require(bool(safe_norm(*self.normal) > 0), f"the plane's normal is {self.normal}: give a direction")

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        unit = self.normal / safe_norm(*self.normal)
        return sum(c * d for c, d in zip(split(x - self.point), unit, strict=True))
