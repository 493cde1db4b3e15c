"""Procedural pyramids of five classes. Only a pattern imprinted on the base tells the class."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray
from jaxnbv.scanning.sdf import PATTERNS, ImprintedPyramid
from jaxnbv.studies.scenes.class_object import ClassObject
from jaxnbv.studies.scenes.framing import Framing
from jaxnbv.studies.scenes.splits import Split, scene_key


class Pyramid(ClassObject):
    """A pyramid in scene coordinates. Its class is the pattern on its base, one of `PATTERNS`."""

    solid: ImprintedPyramid
    label: Int[Array, ""]

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.solid(x)

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Return whether each point of the surface lies on the floor or the walls of the pattern.

        Points must have no noise, because the floor is only a few hundredths below the base.
        """
        distance, height = self.solid.imprint(x)
        return (distance <= tolerance) & (height > tolerance)


def pyramid_scene(
    split: Split, index: int | Int[Array, ""], framing: Framing = Framing.CLOSE_UP, is_rotated: bool = True
) -> Pyramid:
    """Return the pyramid with this index in a split. Its class is `PATTERNS[index % 5]`.

    The height of the pyramid and the size, position, rotation and depth of its pattern are random. The pyramid is
    centred in the scene. It has a random rotation if `is_rotated`, else it is upright along z. The two framings give
    the same pyramid in two sizes. The function runs under `jit` and `vmap`.

    **Raises:** `ValueError` if the index is negative.
    """
    key, label = scene_key(0, split, index), jnp.asarray(index % len(PATTERNS))
    return _pyramid(key, label, framing.longest_side, is_rotated)


# Smallest distance between a pattern and the base's edge. With the ranges below, no pattern breaks through a side.
_MARGIN = 0.1


@functools.partial(jax.jit, static_argnames="is_rotated")
def _pyramid(
    key: PRNGKeyArray, label: Int[Array, ""], longest_side: Float[Array, ""] | float, is_rotated: bool
) -> Pyramid:
    height_key, size_key, place_key, angle_key, depth_key, rotation_key = jax.random.split(key, 6)
    height = jax.random.uniform(height_key, minval=1.2, maxval=1.6)
    size = jax.random.uniform(size_key, minval=0.7, maxval=0.85)
    place = (1.0 - _MARGIN - size) * jax.random.uniform(place_key, (2,), minval=-1.0, maxval=1.0)
    rotation_angle = jax.random.uniform(angle_key, maxval=2.0 * jnp.pi)
    depth = jax.random.uniform(depth_key, minval=0.07, maxval=0.1)
    rotation = jax.random.orthogonal(rotation_key, 3)
    rotation = rotation * jnp.linalg.det(rotation) if is_rotated else jnp.eye(3)
    corners = jnp.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    corners = jnp.concatenate([corners, jnp.stack([0.0, 0.0, height])[None]])
    corners = jnp.matmul(corners, rotation.T, precision="highest")
    low, high = jnp.min(corners, axis=0), jnp.max(corners, axis=0)
    scale = longest_side / jnp.max(high - low)
    offset = -0.5 * scale * (low + high)
    solid = ImprintedPyramid(label, height, size, place, rotation_angle, depth, rotation, scale, offset)
    return Pyramid(solid=solid, label=label)
