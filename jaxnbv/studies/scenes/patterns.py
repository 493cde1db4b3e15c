"""The five patterns of the synthetic pyramid, as signed distances in the plane."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

PATTERNS = ("cross", "ring", "star", "triangle", "square")


def pattern_distance(label: Int[Array, ""], x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Signed distance, negative inside, to the pattern of a label within the unit circle; a bound away from its edge.

    The label counts in `PATTERNS`. All five are evaluated, so that scenes of all classes share one program.
    """
    shapes: tuple[Callable[..., Float[Array, "*n"]], ...] = (_cross, _ring, _star, _triangle, _square)
    return jnp.select([label == index for index in range(len(PATTERNS))], [shape(x, y) for shape in shapes])


def _cross(x, y, reach=0.95, half_width=0.3):
    x, y = jnp.abs(x), jnp.abs(y)
    return jnp.minimum(jnp.maximum(x - reach, y - half_width), jnp.maximum(x - half_width, y - reach))


def _ring(x, y, middle=0.74, half_width=0.24):
    return jnp.abs(jnp.sqrt(jnp.maximum(x**2 + y**2, 1e-12)) - middle) - half_width


def _star(x, y, inner=0.48):
    """Five tips at radius 1; the wedge between a tip and the notch beside it stands for all ten."""
    x = jnp.abs(x)
    half_turn = math.pi / 5
    # Mirrors at 3 and then 1 half turns from the tip on the y axis fold any direction into the first half turn.
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
