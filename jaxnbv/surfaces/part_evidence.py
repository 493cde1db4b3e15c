"""Misfits of placed parts to the rays of all views, and the weights that follow from these misfits.

A ray passes through empty space and meets the object at x. It tests a placed part with signed distance d in two ways:
x should lie on the part's surface, and the ray should not pass through the part before x. The misfit is

    L = sum over rays of  l(d(x)) + l(min over the ray of min(d, 0)),   l(r) = log(1 + r^2 / 2 tau^2)

A ray that did not meet the object has only the second term. Each term is clipped at l(4 tau), which limits the effect
of outliers. tau is twice the noise of the measured ray lengths, but at least 0.03 scene units, the accuracy of a part's
surface on its grid. The noise is estimated from third differences of the lengths at neighbouring pixels. A sensor may
miss a surface. So a ray without a return counts only if it passes through the part in space that was seen to be empty.
Misfits are summed over rays, so the weights become more decisive with more views. If rays meet the object less than
0.12 scene units apart, their errors are dependent, and each counts as less than one ray. The weights are

    w_h proportional to exp(-L_h) for each hypothesis h, a placed part
    w_0 proportional to exp(-L_0) for none of these,   L_0 = sum over rays that met the object of  e_0 + o

Here e_0 is a constant. o is the amount by which l(d(x)) exceeds e_0 for the hypothesis that explains x best. So o
covers points of a different object, which no hypothesis explains. At most a fifth of the points are assumed to belong
to a different object, which limits the sum of o.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.volume import Box, ray_interval
from jaxnbv.observations import Observations
from jaxnbv.programs import program
from jaxnbv.scanning import Grid
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.surfaces.shape_bank import ShapeBank

# Smallest tau in scene units, tau in standard deviations of the noise, and the multiple of tau at which l is clipped.
MIN_TAU, _TAU_PER_NOISE, _CLIP_TAUS = 0.03, 2.0, 4.0
MAX_MISFIT = math.log1p(_CLIP_TAUS**2 / 2.0)
# Standard deviation of a normal distribution divided by the lower quartile of its absolute value. A median would
# overestimate the noise on a thin object, where more than half of the differences cross the object's edges.
_NOISE_PER_QUARTILE = 1.0 / 0.31864
# Smallest stride along a ray in scene units, and number of strides.
_MIN_STRIDE, _NUM_STRIDES = 0.04, 40
# Largest number of rays used from all views together.
_MAX_RAYS = 4096
# Rays that meet the object less than this far apart, in scene units, have dependent errors.
_CORRELATION_LENGTH = 0.12
# e_0, the misfit of "none of these" per ray. The mean misfit per ray is up to 0.15 for the correct part, and in most
# cases at least 0.3 for the best part if the object is none of the parts.
_NONE_MISFIT = 0.25
# Largest fraction of points that is assumed to belong to a different object.
_MAX_STRAY = 0.2


class Rays(NamedTuple):
    """Rays of the views so far, in random order.

    - `sight`: length of each ray in scene units. It is infinite without a return, and zero for padding.
    - `is_object`: whether the ray met the object.
    - `weight`: number of independent rays that the ray counts as. It is lower if rays are closer together than
      `_CORRELATION_LENGTH`, and higher if the ray also represents rays that were left out.
    - `empty_nodes`: mask of the nodes of `grid` that were seen to be empty.
    - `tau`: scale of residuals in scene units, see `misfit_of`.
    """

    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]
    sight: Float[Array, " n"]
    is_object: Bool[Array, " n"]
    weight: Float[Array, " n"]
    empty_nodes: Bool[Array, "g g g"]
    grid: Grid
    tau: Float[Array, ""]

    @classmethod
    @program
    def of(cls, observations: Observations, box: Box) -> "Rays | None":
        """Return up to 4096 rays that enter a box, from all views; None if the observations store no rays."""
        looks, poses = observations.looks, observations.poses
        if looks is None or observations.empty_nodes is None:
            return None
        origins, directions = (rows.reshape(-1, 3) for rows in looks.camera.rays(poses.rows))
        count, sight = len(origins), looks.sight.reshape(-1)
        has_return = jnp.isfinite(sight) & (sight > 0)
        points = origins + jnp.where(has_return, sight, 0.0)[:, None] * directions
        is_object = has_return & (looks(points) <= looks.grid.spacing)
        noise = _estimate_noise(looks.sight, is_object, looks.camera)
        distance = jnp.sum(jnp.where(is_object, sight, 0.0)) / jnp.maximum(jnp.sum(is_object), 1)

        enter, leave = ray_interval(list(origins.T), list(directions.T), box.low, box.high)
        is_usable = (sight > 0) & (leave > jnp.maximum(enter, 0.0))
        order = jnp.asarray(np.random.default_rng(0).permutation(count))
        indices, weights = [], []
        for kind in (is_usable & is_object, is_usable & ~is_object):
            (rows,) = jnp.nonzero(kind[order], size=_MAX_RAYS // 2, fill_value=count)
            indices.append(order.at[rows].get(mode="fill", fill_value=count))
            factor = jnp.maximum(2.0 * jnp.sum(kind) / _MAX_RAYS, 1.0)
            weights.append(jnp.broadcast_to(factor * jnp.minimum(ray_weight(distance, looks.camera), 1.0), rows.shape))
        # Rays that met the object alternate with other rays, so that the first few rays contain both kinds.
        index, weight = (jnp.stack(parts, axis=1).reshape(-1) for parts in (indices, weights))
        row = jnp.minimum(index, count - 1)
        return cls(
            origins[row],
            directions[row],
            jnp.where(index < count, sight[row], 0.0),
            is_object[row] & (index < count),
            weight,
            observations.empty_nodes,
            looks.grid,
            jnp.maximum(MIN_TAU, _TAU_PER_NOISE * noise),
        )

    def first(self, count: int) -> "Rays":
        """Return the first `count` rays, with weights increased to represent all rays."""
        weight, is_filled = self.weight[:count], self.sight > 0
        for kind in (self.is_object & is_filled, ~self.is_object & is_filled):
            factor = jnp.sum(kind) / jnp.maximum(jnp.sum(kind[:count]), 1)
            weight = jnp.where(kind[:count], factor * weight, weight)
        origins, directions, sight, is_object = (leaf[:count] for leaf in self[:4])
        return Rays(origins, directions, sight, is_object, weight, self.empty_nodes, self.grid, self.tau)


def _estimate_noise(
    sight: Float[Array, "views rays"], is_object: Bool[Array, " all_rays"], camera: Camera
) -> Float[Array, ""]:
    """Return the standard deviation of the noise in the ray lengths on the object, or zero without data.

    It is computed from third differences of the lengths along rows and columns of an image. Without noise, these
    differences are near zero on a surface of low curvature.
    """
    images = jnp.where(is_object, sight.reshape(-1), jnp.nan).reshape(-1, camera.height, camera.width)
    differences = [jnp.diff(images, 3, axis=axis).reshape(-1) for axis in (1, 2)]
    # The squares of the coefficients 1, 3, 3, 1 sum to 20.
    quartile = jnp.nanquantile(jnp.abs(jnp.concatenate(differences)), 0.25)
    return jnp.nan_to_num(_NOISE_PER_QUARTILE / math.sqrt(20.0) * quartile)


@program
def evidence(bank: ShapeBank, hypotheses: Hypotheses, rays: Rays) -> tuple[Float[Array, " h"], Float[Array, ""]]:
    """Return the misfit L of each hypothesis, summed over the rays, and the misfit of "none of these"."""
    points = rays.origins + jnp.where(rays.is_object, rays.sight, 0.0)[:, None] * rays.directions

    def misfit_of_part(one):
        solid = bank.shape(one.shape).solid

        def distance(x):
            return one.placement.distance(solid, x)

        point_misfit = jnp.where(rays.is_object, misfit_of(distance(points), rays.tau), 0.0)
        penetration, is_evidence = _deepest_penetration(distance, rays)
        penetration = jnp.where(is_evidence, misfit_of(penetration, rays.tau), 0.0)
        return jnp.sum(rays.weight * jnp.where(rays.sight > 0, point_misfit + penetration, 0.0)), point_misfit

    misfits, point_misfits = jax.lax.map(misfit_of_part, hypotheses, batch_size=8)
    weight = jnp.where(rays.is_object, rays.weight, 0.0)
    stray = jnp.sum(weight * jnp.maximum(jnp.min(point_misfits, axis=0) - _NONE_MISFIT, 0.0))
    return misfits, _NONE_MISFIT * jnp.sum(weight) + jnp.minimum(stray, _MAX_STRAY * MAX_MISFIT * jnp.sum(weight))


def ray_weight(distance: Float[Array, ""], camera: Camera) -> Float[Array, ""]:
    """Return how many independent rays one ray of a camera stands for, if the object is at this distance.

    It is the ray's area on the object divided by the area within which rays have dependent errors.
    """
    fx, fy = camera.focal_lengths
    return distance**2 / (fx * fy * _CORRELATION_LENGTH**2)


def misfit_of(distance: Float[Array, "*n"], tau: Float[Array, ""]) -> Float[Array, "*n"]:
    """Return log(1 + d^2 / (2 tau^2)) for distances d in scene units, clipped at its value for d = 4 tau."""
    return jnp.minimum(jnp.log1p(distance**2 / (2.0 * tau**2)), MAX_MISFIT)


def _deepest_penetration(
    distance: Callable[[Float[Array, "n 3"]], Float[Array, " n"]], rays: Rays
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Return the smallest signed distance to a solid along each ray, and whether it counts as evidence.

    A ray ends at its measured point. The distance is zero if the ray misses the solid. The distance counts as evidence
    if the ray has a return, or if the point with the smallest distance was seen to be empty.
    """

    def stride(state, _):
        length, deepest, deepest_length = state
        value = distance(rays.origins + length[:, None] * rays.directions)
        is_deeper = (length < rays.sight - rays.tau) & (value < deepest)
        deepest, deepest_length = jnp.where(is_deeper, value, deepest), jnp.where(is_deeper, length, deepest_length)
        return (length + jnp.maximum(jnp.abs(value), _MIN_STRIDE), deepest, deepest_length), None

    zero = jnp.zeros_like(rays.sight)
    (_, deepest, deepest_length), _ = jax.lax.scan(stride, (zero, zero, zero), length=_NUM_STRIDES)
    points = rays.origins + deepest_length[:, None] * rays.directions
    node = jnp.round((points + rays.grid.half_extent) / rays.grid.spacing).astype(jnp.int32)
    node = jnp.where(jnp.all(node >= 0, axis=-1, keepdims=True), node, rays.grid.resolution)
    was_empty = rays.empty_nodes.at[tuple(node.T)].get(mode="fill", fill_value=False)
    return deepest, jnp.isfinite(rays.sight) | was_empty
