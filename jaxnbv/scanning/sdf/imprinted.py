"""A pyramid with one of five patterns pressed into its base."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxnbv.checks import AnyArray
from jaxnbv.scanning.sdf.base import Matrix, Scalar, SignedDistance, Vector, nonnegative, parameter

PATTERNS = ("cross", "ring", "star", "triangle", "square")


class ImprintedPyramid(SignedDistance):
    """A pyramid on a square base with a pattern pressed into the base. The distance is a lower bound.

    In the pyramid's own frame the base is [-1, 1]^2 at z = 0 and the apex is at (0, 0, height). A point u in this frame
    lies at `scale * rotation @ u + offset` in the scene.

    - `pattern`: index of the pattern in `PATTERNS`.
    - `size`, `place`, `turn`, `depth`: radius, centre, angle (radians) and depth of the pattern in the pyramid's frame.
    """

    pattern: Int[Array, ""]
    height: Scalar = nonnegative()
    size: Scalar = nonnegative()
    place: Float[Array, "2"] = parameter()
    turn: Scalar = parameter()
    depth: Scalar = nonnegative()
    rotation: Matrix = parameter()
    scale: Scalar = nonnegative()
    offset: Vector = parameter()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        u, v, w = self._local(x)
        slant = jnp.sqrt(1.0 + self.height**2)
        sides = ((jnp.maximum(jnp.abs(u), jnp.abs(v)) - 1.0) * self.height + w) / slant
        return self.scale * jnp.maximum(jnp.maximum(sides, -w), -self._imprint(u, v, w))

    def imprint(self, x: Float[AnyArray, "*n 3"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Return the signed distance of points x to the pressed-in prism, and their height above the base."""
        u, v, w = self._local(x)
        return self.scale * self._imprint(u, v, w), self.scale * w

    def _local(self, x):
        a, b, c = (x[..., i, None] - self.offset[i] for i in range(3))
        rotation = self.rotation / self.scale
        local = a * rotation[0] + b * rotation[1] + c * rotation[2]
        return local[..., 0], local[..., 1], local[..., 2]

    def _imprint(self, u, v, w):
        """Return the signed distance, in the pyramid's frame, to the prism, which has no end below the base."""
        c, s = jnp.cos(self.turn) / self.size, jnp.sin(self.turn) / self.size
        u, v = u - self.place[0], v - self.place[1]
        flat = self.size * pattern_distance(self.pattern, c * u + s * v, c * v - s * u)
        return jnp.maximum(flat, w - self.depth)


def pattern_distance(pattern: Int[Array, ""], x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return a lower bound on the signed distance from points (x, y) to a pattern in the unit circle.

    - `pattern`: index in `PATTERNS`. All patterns are evaluated, so that scenes of all classes share one program.
    """
    shapes: tuple[Callable[..., Float[Array, "*n"]], ...] = (_cross, _ring, _star, _triangle, _square)
    return jnp.select([pattern == index for index in range(len(PATTERNS))], [shape(x, y) for shape in shapes])


def _cross(x, y, reach=0.95, half_width=0.3):
    x, y = jnp.abs(x), jnp.abs(y)
    return jnp.minimum(jnp.maximum(x - reach, y - half_width), jnp.maximum(x - half_width, y - reach))


def _ring(x, y, middle=0.74, half_width=0.24):
    return jnp.abs(jnp.sqrt(jnp.maximum(x**2 + y**2, 1e-12)) - middle) - half_width


def _star(x, y, inner=0.48):
    """Return the signed distance to a star with five tips at radius 1 and notches at radius `inner`."""
    x = jnp.abs(x)
    half_turn = math.pi / 5
    # The star has ten congruent wedges between a tip and a notch. Two mirrors, at angles of 3 and 1 times pi / 5 from
    # the tip on the y axis, map all directions to the wedge beside this tip.
    for angle in (3 * half_turn, half_turn):
        c, s = math.cos(angle), math.sin(angle)
        beyond = jnp.maximum(x * c - y * s, 0.0)
        x, y = x - 2.0 * beyond * c, y + 2.0 * beyond * s
    x = jnp.abs(x)
    notch_x, notch_y = inner * math.sin(half_turn), inner * math.cos(half_turn)
    normal_x, normal_y = 1.0 - notch_y, notch_x
    length = math.hypot(normal_x, normal_y)
    return (x * normal_x + (y - 1.0) * normal_y) / length


def _triangle(x, y):
    return jnp.maximum(jnp.abs(x) * math.cos(math.pi / 6) + 0.5 * y, -y) - 0.5


def _square(x, y, half_side=0.7):
    return jnp.maximum(jnp.abs(x), jnp.abs(y)) - half_side
