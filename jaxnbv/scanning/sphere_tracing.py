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

# The shortest stride, in scene units, is far above the rounding of float32 distances in the scene (4e-7) and far below
# the size of relevant detail.
_SHORTEST_STRIDE = 1e-3
_MAX_STRIDES = 512
# Once at most this fraction of the rays is unfinished, the unfinished rays continue in a smaller batch.
_FEW = 1 / 8
_CHORDS = 2
# Slopes are evaluated this far before a hit along the ray, in units of the machine epsilon. The length is 1e-5 scene
# units in float32, which is above the rounding of a hit and below the size of any detail.
_FRONT = 84
# Derivatives of hits are exact if the sine of the angle between the ray and the surface is at least this.
_GRAZING = 0.05


class SDFSurface(Surface):
    """The boundary of a solid, traced by sphere tracing (Hart 1996).

    - `sdf`: the solid.
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
        along = _Along(self.sdf, origins, directions)
        fixed = jax.lax.stop_gradient(along)
        depth, mask = _first_root(fixed.sdf, fixed.origins, fixed.directions, self.bounding_radius)
        # Slopes are evaluated just in front of the surface. On the surface, a solid's formula may be at the border of
        # two cases, and rounding may give a slope that belongs to neither case.
        before = _Along(self.sdf, origins - _FRONT * jnp.finfo(origins.dtype).eps * directions, directions)
        depth = implicit_depth(before, fixed.newton(depth), mask, jnp.full_like(depth, _GRAZING))
        points, front = along.points(depth), before.points(depth)
        # Forward mode compiles to one pass over the points. Reverse mode would not, because of its scatter operations.
        axes = jnp.broadcast_to(jnp.eye(3, dtype=points.dtype)[:, None], (3, *points.shape))
        gradient = jax.vmap(lambda axis: jax.jvp(self.sdf, (front,), (axis,))[1], out_axes=-1)(axes)
        gradient = jnp.where(jnp.any(gradient != 0, axis=-1, keepdims=True), gradient, -directions)
        facing = -jnp.sign(jnp.sum(gradient * directions, axis=-1, keepdims=True))
        normals = jnp.where(facing == 0, 1.0, facing) * gradient / jnp.linalg.norm(gradient, axis=-1, keepdims=True)
        return Hits(jnp.where(mask[:, None], points, 0.0), jnp.where(mask[:, None], normals, 0.0), mask)


class _Along(eqx.Module):
    """The signed distance of a solid as a function of depth along rays."""

    sdf: SignedDistance
    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]

    def points(self, depth: Float[Array, " n"]) -> Float[Array, "n 3"]:
        return self.origins + depth[:, None] * self.directions

    def __call__(self, depth: Float[Array, " n"]) -> Float[Array, " n"]:
        return self.sdf(self.points(depth))

    def newton(self, depth: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return depths after one Newton step towards the root, exact to rounding except for grazing rays."""
        value, slope = jax.jvp(self, (depth,), (jnp.ones_like(depth),))
        return depth - value / (jnp.where(slope < 0, -1.0, 1.0) * jnp.maximum(jnp.abs(slope), _GRAZING))


def _first_root(
    sdf: SignedDistance, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], radius: float
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Return the depth at which each ray first crosses the solid's boundary, and whether it does.

    At the crossing, the sign of the distance changes. Only the ball of `radius` about the scene's origin is searched.
    """
    middle = -jnp.sum(origins * directions, axis=-1)
    squared = middle**2 - jnp.sum(origins**2, axis=-1) + radius**2
    half_chord = jnp.sqrt(jnp.maximum(squared, 0.0))
    enter, leave = jnp.maximum(middle - half_chord, 0.0), middle + half_chord

    start = sdf(origins + enter[:, None] * directions)
    alive = (squared > 0) & (leave > 0)
    march = _March(origins, directions, jnp.where(start < 0, -1.0, 1.0), leave, enter, start, enter, start, alive)

    # Nearly all rays finish within a few strides. The unfinished rays continue in a smaller batch.
    few = math.ceil(len(origins) * _FEW)
    march, count = _advance(sdf, march, 0, few)
    (rest,) = jnp.nonzero(march.alive, size=few, fill_value=len(origins))
    stragglers = jax.tree.map(lambda leaf: leaf.at[rest].get(mode="fill", fill_value=0), march)
    stragglers, _ = _advance(sdf, stragglers, count, 0)
    march = jax.tree.map(lambda leaf, part: leaf.at[rest].set(part, mode="drop"), march, stragglers)

    mask = alive & ~march.alive & (march.side * march.f <= 0)
    return jnp.where(mask, _refine(sdf, march), 0.0), mask


class _March(eqx.Module):
    """State of the rays during sphere tracing.

    - `side`: sign of the signed distance at the start of each ray.
    - `leave`: depth at which the ray leaves the ball in which surfaces are searched.
    - `depth`, `f`: current depth, and the signed distance at this depth.
    - `before`, `f_before`: depth one stride earlier, and the signed distance at that depth.
    - `alive`: whether the ray is unfinished.
    """

    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]
    side: Float[Array, " n"]
    leave: Float[Array, " n"]
    before: Float[Array, " n"]
    f_before: Float[Array, " n"]
    depth: Float[Array, " n"]
    f: Float[Array, " n"]
    alive: Bool[Array, " n"]


def _advance(sdf: SignedDistance, march: _March, count, enough: int):
    """Advance the rays until at most `enough` are unfinished or `_MAX_STRIDES` strides are used up.

    Returns the rays and the total number of strides, which starts at `count`.
    """
    along = _Along(sdf, march.origins, march.directions)

    def body(carry):
        count, before, f_before, depth, f, alive = carry
        further = depth + jnp.maximum(jnp.abs(f), _SHORTEST_STRIDE)
        before, f_before = jnp.where(alive, depth, before), jnp.where(alive, f, f_before)
        depth, f = jnp.where(alive, further, depth), jnp.where(alive, along(further), f)
        return count + 1, before, f_before, depth, f, alive & (march.side * f > 0) & (depth < march.leave)

    carry = (count, march.before, march.f_before, march.depth, march.f, march.alive)
    count, *rest = jax.lax.while_loop(lambda c: (c[0] < _MAX_STRIDES) & (jnp.sum(c[-1]) > enough), body, carry)
    return _March(march.origins, march.directions, march.side, march.leave, *rest), count


def _refine(sdf: SignedDistance, march: _March) -> Float[Array, " n"]:
    """Return the depth of the root within each ray's last stride, by regula falsi.

    The interval is short, so a few chords are enough to reach the rounding error.
    """
    along = _Along(sdf, march.origins, march.directions)

    def chord(_, bracket):
        low, f_low, high, f_high = bracket
        drop = f_low - f_high
        root = low + (high - low) * f_low / jnp.where(drop == 0, 1.0, drop)
        f = along(root)
        ahead = march.side * f > 0
        low, f_low = jnp.where(ahead, root, low), jnp.where(ahead, f, f_low)
        high, f_high = jnp.where(ahead, high, root), jnp.where(ahead, f_high, f)
        return low, f_low, high, f_high

    bracket = march.before, march.f_before, march.depth, march.f
    low, f_low, high, f_high = jax.lax.fori_loop(0, _CHORDS, chord, bracket)
    return jnp.where(jnp.abs(f_low) < jnp.abs(f_high), low, high)
