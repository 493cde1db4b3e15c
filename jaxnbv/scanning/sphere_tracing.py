"""`SDFSurface`: the boundary of a solid with a signed distance function, traced by sphere tracing."""

import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray, check_fields, require
from jaxnbv.programs import program
from jaxnbv.scanning.scanner import Hits, Surface, implicit_depth
from jaxnbv.scanning.sdf import SignedDistance

# This is far above the rounding of float32 distances in the scene (4e-7) and far below the size of relevant detail.
_SHORTEST_STRIDE = 1e-3
_MAX_STRIDES = 512
# Nearly all rays finish within a few strides. Once at most this fraction is left, the rest continue in a smaller batch.
_MAX_UNFINISHED = 1 / 8
_NUM_CHORDS = 2
# Slopes are evaluated this far before a hit along the ray, in units of the machine epsilon. The length is 1e-5 scene
# units in float32, which is above the rounding of a hit and below the size of any detail.
_FRONT_OFFSET = 84
# Derivatives of hits are exact if the sine of the angle between the ray and the surface is at least this.
_MIN_SLOPE = 0.05


class SDFSurface(Surface):
    """The boundary of a solid, traced by sphere tracing (Hart 1996).

    - `bounding_radius`: radius of a ball about the scene's origin. Rays hit nothing outside the ball. The default ball
      holds the whole scene, [-pi/2, pi/2]^3.

    A ray advances by |sdf|, but by at least 0.001, until the sign changes. The root is then located within the last
    stride. A ray may miss a part that is thinner than 0.001 along the ray. A ray at an angle of less than a degree to a
    flat face may use up its 512 strides and miss the face.

    Hits are differentiable in the rays and in the solid's parameters, see `implicit_depth`. For grazing rays, the
    derivative is bounded: it uses a slope of at least 0.05.

    **Raises:** `ValueError` if the bounding radius is not positive.
    """

    sdf: SignedDistance
    bounding_radius: float = eqx.field(static=True, default=0.5 * math.pi * math.sqrt(3.0))
    in_jit: ClassVar[bool] = True

    def __check_init__(self):
        check_fields(self)
        require(self.bounding_radius > 0, f"the bounding radius is {self.bounding_radius}; it must be positive")

    def contains(self, points: Float[AnyArray, "n 3"]) -> Bool[Array, " n"]:
        return self.sdf(jnp.asarray(points)) < 0

    @property
    def class_label(self) -> Int[AnyArray, ""] | None:
        return self.sdf.class_label

    def part_labels(self, points: Float[Array, "n 3"]) -> Int[Array, " n"] | None:
        return self.sdf.part_labels(points)

    @program
    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        origins, directions = jnp.asarray(origins), jnp.asarray(directions)
        distance = _DistanceAlongRay(self.sdf, origins, directions)
        constant = jax.lax.stop_gradient(distance)
        depth, mask = _first_root(constant.sdf, constant.origins, constant.directions, self.bounding_radius)
        # Slopes are evaluated just in front of the surface. On the surface, a solid's formula may be at the border of
        # two cases, and rounding may give a slope that belongs to neither case.
        front_origins = origins - _FRONT_OFFSET * jnp.finfo(origins.dtype).eps * directions
        front_distance = _DistanceAlongRay(self.sdf, front_origins, directions)
        depth = implicit_depth(front_distance, constant.newton(depth), mask, jnp.full_like(depth, _MIN_SLOPE))
        points, front_points = distance.points(depth), front_distance.points(depth)
        # Forward mode compiles to one pass over the points. Reverse mode would not, because of its scatter operations.
        axes = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype)[:, None], (3, *points.shape))
        gradient = jax.vmap(lambda axis: jax.jvp(self.sdf, (front_points,), (axis,))[1], out_axes=-1)(axes)
        gradient = jnp.where(jnp.any(gradient != 0, axis=-1, keepdims=True), gradient, -directions)
        facing = -jnp.sign(jnp.sum(gradient * directions, axis=-1, keepdims=True))
        normals = jnp.where(facing == 0, 1.0, facing) * gradient / jnp.linalg.norm(gradient, axis=-1, keepdims=True)
        return Hits(jnp.where(mask[:, None], points, 0.0), jnp.where(mask[:, None], normals, 0.0), mask)


class _DistanceAlongRay(eqx.Module):
    sdf: SignedDistance
    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]

    def points(self, depth: Float[Array, " n"]) -> Float[Array, "n 3"]:
        return self.origins + depth[:, None] * self.directions

    def __call__(self, depth: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.sdf(self.points(depth))

    def newton(self, depth: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return depths after a Newton step from near a root, exact to rounding except for grazing rays."""
        value, slope = jax.jvp(self, (depth,), (jnp.ones_like(depth),))
        return depth - value / (jnp.where(slope < 0, -1.0, 1.0) * jnp.maximum(jnp.abs(slope), _MIN_SLOPE))


def _first_root(
    sdf: SignedDistance, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], radius: float
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Return the depth of each ray's first crossing of the boundary, and whether there is such a crossing.

    Only crossings within `radius` of the origin count.
    """
    middle = -jnp.sum(origins * directions, axis=-1)
    squared = middle**2 - jnp.sum(origins**2, axis=-1) + radius**2
    half_chord = jnp.sqrt(jnp.maximum(squared, 0.0))
    min_depth, max_depth = jnp.maximum(middle - half_chord, 0.0), middle + half_chord

    value = sdf(origins + min_depth[:, None] * directions)
    meets_ball = (squared > 0) & (max_depth > 0)
    sign = jnp.where(value < 0, -1.0, 1.0)
    march = _March(origins, directions, sign, max_depth, min_depth, value, min_depth, value, meets_ball)

    max_unfinished = math.ceil(len(origins) * _MAX_UNFINISHED)
    march, count = _advance(sdf, march, 0, max_unfinished)
    (rows,) = jnp.nonzero(march.is_unfinished, size=max_unfinished, fill_value=len(origins))
    stragglers = jax.tree.map(lambda leaf: leaf.at[rows].get(mode="fill", fill_value=0), march)
    stragglers, _ = _advance(sdf, stragglers, count, 0)
    march = jax.tree.map(lambda leaf, part: leaf.at[rows].set(part, mode="drop"), march, stragglers)

    mask = meets_ball & ~march.is_unfinished & (march.start_sign * march.value <= 0)
    return jnp.where(mask, _refine(sdf, march), 0.0), mask


class _March(eqx.Module):
    """State of the rays during sphere tracing.

    - `start_sign`: sign of the signed distance at the start of each ray.
    - `max_depth`: depth at which the ray leaves the ball in which surfaces are searched.
    - `depth`, `value`: current depth, and the signed distance there. `previous_...`: the same, one stride earlier.
    - `is_unfinished`: whether the ray has neither crossed the boundary nor left the ball.
    """

    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]
    start_sign: Float[Array, " n"]
    max_depth: Float[Array, " n"]
    previous_depth: Float[Array, " n"]
    previous_value: Float[Array, " n"]
    depth: Float[Array, " n"]
    value: Float[Array, " n"]
    is_unfinished: Bool[Array, " n"]


def _advance(sdf: SignedDistance, march: _March, count, max_unfinished: int):
    """Advance all unfinished rays, stride by stride, until at most `max_unfinished` rays are unfinished.

    Return the rays and the number of strides. The rays also stop once this number is `_MAX_STRIDES`.

    - `count`: number of strides so far.
    """
    distance = _DistanceAlongRay(sdf, march.origins, march.directions)

    def body(carry):
        count, previous_depth, previous_value, depth, value, is_unfinished = carry
        next_depth = depth + jnp.maximum(jnp.abs(value), _SHORTEST_STRIDE)
        previous_depth = jnp.where(is_unfinished, depth, previous_depth)
        previous_value = jnp.where(is_unfinished, value, previous_value)
        depth = jnp.where(is_unfinished, next_depth, depth)
        value = jnp.where(is_unfinished, distance(next_depth), value)
        is_unfinished = is_unfinished & (march.start_sign * value > 0) & (depth < march.max_depth)
        return count + 1, previous_depth, previous_value, depth, value, is_unfinished

    carry = (count, march.previous_depth, march.previous_value, march.depth, march.value, march.is_unfinished)
    count, *rest = jax.lax.while_loop(lambda c: (c[0] < _MAX_STRIDES) & (jnp.sum(c[-1]) > max_unfinished), body, carry)
    return _March(march.origins, march.directions, march.start_sign, march.max_depth, *rest), count


def _refine(sdf: SignedDistance, march: _March) -> Float[Array, " n"]:
    """Return the depth of the root in each ray's last stride, exact to rounding, by the regula falsi."""
    distance = _DistanceAlongRay(sdf, march.origins, march.directions)

    def chord(_, bracket):
        low, low_value, high, high_value = bracket
        drop = low_value - high_value
        root = low + (high - low) * low_value / jnp.where(drop == 0, 1.0, drop)
        value = distance(root)
        is_before_root = march.start_sign * value > 0
        low, low_value = jnp.where(is_before_root, root, low), jnp.where(is_before_root, value, low_value)
        high, high_value = jnp.where(is_before_root, high, root), jnp.where(is_before_root, high_value, value)
        return low, low_value, high, high_value

    bracket = march.previous_depth, march.previous_value, march.depth, march.value
    low, low_value, high, high_value = jax.lax.fori_loop(0, _NUM_CHORDS, chord, bracket)
    return jnp.where(jnp.abs(low_value) < jnp.abs(high_value), low, high)
