"""The synthetic pyramid: five classes that differ in a pattern imprinted on the base, and in nothing else."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray
from jaxnbv.scanning.sdf import Matrix, Scalar, Vector, nonnegative, parameter
from jaxnbv.studies.scenes.class_object import ClassObject
from jaxnbv.studies.scenes.framing import Framing
from jaxnbv.studies.scenes.splits import Split, scene_key

PATTERNS = ("cross", "ring", "star", "triangle", "square")


class Pyramid(ClassObject):
    """A pyramid on a square base into which a pattern is pressed; a bound.

    In its own frame the base is [-1, 1]^2 at z = 0 and the apex stands at (0, 0, height); a point u of it lies at
    `scale * rotation @ u + offset` in the scene.

    - `label`: the class, an index of `PATTERNS`.
    - `size`, `place`, `turn`, `depth`: the pattern's radius, centre, angle and depth, in the pyramid's frame.
    """

    label: Int[Array, ""]
    height: Scalar = nonnegative()
    size: Scalar = nonnegative()
    place: Float[Array, "2"] = parameter()
    turn: Scalar = parameter()
    depth: Scalar = nonnegative()
    rotation: Matrix = parameter()
    scale: Scalar = nonnegative()
    offset: Vector = parameter()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        u, v, w = self._own(x)
        slant = jnp.sqrt(1.0 + self.height**2)
        sides = ((jnp.maximum(jnp.abs(u), jnp.abs(v)) - 1.0) * self.height + w) / slant
        return self.scale * jnp.maximum(jnp.maximum(sides, -w), -self._imprint(u, v, w))

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Which points of the surface belong to the pattern, its floor or its walls; the tolerance is in scene units.

        Give hits without noise: a floor is a few hundredths below the base.
        """
        u, v, w = self._own(x)
        return (self.scale * self._imprint(u, v, w) <= tolerance) & (self.scale * w > tolerance)

    def _own(self, x):
        a, b, c = (x[..., i, None] - self.offset[i] for i in range(3))
        rotation = self.rotation / self.scale
        own = a * rotation[0] + b * rotation[1] + c * rotation[2]
        return own[..., 0], own[..., 1], own[..., 2]

    def _imprint(self, u, v, w):
        """Signed distance to the prism that was pressed into the base, without end below it."""
        c, s = jnp.cos(self.turn) / self.size, jnp.sin(self.turn) / self.size
        u, v = u - self.place[0], v - self.place[1]
        flat = self.size * pattern_distance(self.label, c * u + s * v, c * v - s * u)
        return jnp.maximum(flat, w - self.depth)


def pyramid_scene(
    split: Split, index: int | Int[Array, ""], framing: Framing = Framing.CLOSE_UP, turned: bool = True
) -> Pyramid:
    """Scene number `index` of a split, the same pyramid in both framings; the classes take turns.

    A pyramid with random height and pattern, centred in the scene, and turned in any direction or, not `turned`,
    upright along z. Runs under `jit` and `vmap`.

    **Raises:** `ValueError` if the index is negative.
    """
    key, label = scene_key(0, split, index), jnp.asarray(index % len(PATTERNS))
    return _pyramid(key, label, framing.longest_side, turned)


# Least distance of a pattern from the base's edge: with the ranges below no pattern breaks through a side.
_MARGIN = 0.1


@functools.partial(jax.jit, static_argnames="turned")
def _pyramid(key: PRNGKeyArray, label: Int[Array, ""], longest_side: Float[Array, ""] | float, turned: bool) -> Pyramid:
    height_key, size_key, place_key, turn_key, depth_key, rotation_key = jax.random.split(key, 6)
    height = jax.random.uniform(height_key, minval=1.2, maxval=1.6)
    size = jax.random.uniform(size_key, minval=0.7, maxval=0.85)
    place = (1.0 - _MARGIN - size) * jax.random.uniform(place_key, (2,), minval=-1.0, maxval=1.0)
    turn = jax.random.uniform(turn_key, maxval=2.0 * jnp.pi)
    depth = jax.random.uniform(depth_key, minval=0.07, maxval=0.1)
    rotation = jax.random.orthogonal(rotation_key, 3)
    rotation = rotation * jnp.linalg.det(rotation) if turned else jnp.eye(3)
    corners = jnp.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    corners = jnp.concatenate([corners, jnp.stack([0.0, 0.0, height])[None]])
    corners = jnp.matmul(corners, rotation.T, precision="highest")
    low, high = jnp.min(corners, axis=0), jnp.max(corners, axis=0)
    scale = longest_side / jnp.max(high - low)
    return Pyramid(label, height, size, place, turn, depth, rotation, scale, -0.5 * scale * (low + high))


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
