"""How well placed parts explain what every ray of every view came back with, and what follows for their weights.

A ray that met the object at x, and came there through space that is empty, speaks of a placed part of signed distance d
by how far x is from its surface, and how deep the ray went through it:

    L = sum over rays of  l(d(x)) + l(min over the ray of min(d, 0)),   l(r) = log(1 + r^2 / 2 tau^2)

without the first term for a ray that did not meet the object. No term is more than C = l(4 tau): what is far off says
no more than what is off. tau is twice the noise of the sights, which their third differences from pixel to pixel show,
and no less than 0.03 scene units, to which a part's surface is known on its grid. A ray from which nothing came back
counts where it went through a part in space that was seen to be empty: a sensor may miss a surface. Misfits add up, so
that weights sharpen with evidence; but rays that meet the object closer together than 0.12 err together, and count as
fewer:

    w_h proportional to exp(-L_h),   w_0 (none of these) to exp(-L_0),   L_0 = sum over rays of e_0 + o,

over the rays that met the object, o what the best of all hypotheses leaves of l(d(x)) beyond e_0: a point that none
explains is none of the object's, of a fifth of the points at most.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.volume import Box, ray_interval
from jaxnbv.observations import Observations
from jaxnbv.scanning import Grid
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.surfaces.shape_bank import ShapeBank

# tau at least, in scene units; in standard deviations of the noise; and where misfits end, in tau.
LEAST_TAU, _TAU_OF_NOISE, _FAR = 0.03, 2.0, 4.0
MOST = math.log1p(_FAR**2 / 2.0)
# The standard deviation of a normal distribution in lower quartiles of its absolute value. More than half of the
# differences of a thin object go across its edges, so that a median would take these for noise.
_BY_QUARTILE = 1.0 / 0.31864
# The least stride along a ray, and how many are taken.
_STRIDE, _NUM_STRIDES = 0.04, 40
# All views together speak by so many rays, at most.
_NUM_RAYS = 4096
# Rays that are closer together on the object err together: scene units.
_APART = 0.12
# Parts that are right leave up to 0.15 a ray, and most objects that are none of them 0.3 or more.
_NONE_MISFIT = 0.25
# The share of the points that met something else, at most.
_STRAY = 0.2


class Rays(NamedTuple):
    """What rays of the views so far came back with, in random order.

    - `sight`: how far each went, without end where nothing came back; zero for a row that holds none.
    - `is_object`: whether it met the object there.
    - `weight`: what each counts: one, or less where rays are closer together than the errors of a surface, and more
      where it stands for others.
    - `empty_nodes`: of `grid`, those that were seen empty.
    - `tau`: how far a point may lie from the surface that it was measured on, in scene units.
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
    @eqx.filter_jit
    def of(cls, observations: Observations, box: Box) -> "Rays | None":
        """Those that enter a box; None where the observations keep no looks."""
        looks, poses = observations.looks, observations.poses
        if looks is None or observations.empty_nodes is None:
            return None
        origins, directions = (rows.reshape(-1, 3) for rows in looks.camera.rays(poses.rows))
        count, sight = len(origins), looks.sight.reshape(-1)
        returned = jnp.isfinite(sight) & (sight > 0)
        points = origins + jnp.where(returned, sight, 0.0)[:, None] * directions
        is_object = returned & (looks(points) <= looks.grid.spacing)
        noise = _noise_of(looks.sight, is_object, looks.camera)
        away = jnp.sum(jnp.where(is_object, sight, 0.0)) / jnp.maximum(jnp.sum(is_object), 1)

        enter, leave = ray_interval(list(origins.T), list(directions.T), box.low, box.high)
        is_known = (sight > 0) & (leave > jnp.maximum(enter, 0.0))
        order = jnp.asarray(np.random.default_rng(0).permutation(count))
        chosen, weights = [], []
        for kind in (is_known & is_object, is_known & ~is_object):
            (rows,) = jnp.nonzero(kind[order], size=_NUM_RAYS // 2, fill_value=count)
            chosen.append(order.at[rows].get(mode="fill", fill_value=count))
            share = jnp.maximum(2.0 * jnp.sum(kind) / _NUM_RAYS, 1.0)
            weights.append(jnp.broadcast_to(share * jnp.minimum(weight_of(away, looks.camera), 1.0), rows.shape))
        # One of each kind in turn, so that the first few are of both.
        picked, weight = (jnp.stack(parts, axis=1).reshape(-1) for parts in (chosen, weights))
        at = jnp.minimum(picked, count - 1)
        return cls(
            origins[at],
            directions[at],
            jnp.where(picked < count, sight[at], 0.0),
            is_object[at] & (picked < count),
            weight,
            observations.empty_nodes,
            looks.grid,
            jnp.maximum(LEAST_TAU, _TAU_OF_NOISE * noise),
        )

    def first(self, count: int) -> "Rays":
        """The first few, each of which stands for more."""
        weight, holds = self.weight[:count], self.sight > 0
        for kind in (self.is_object & holds, ~self.is_object & holds):
            share = jnp.sum(kind) / jnp.maximum(jnp.sum(kind[:count]), 1)
            weight = jnp.where(kind[:count], share * weight, weight)
        origins, directions, sight, is_object = (leaf[:count] for leaf in self[:4])
        return Rays(origins, directions, sight, is_object, weight, self.empty_nodes, self.grid, self.tau)


def _noise_of(
    sight: Float[Array, "views rays"], is_object: Bool[Array, " all_rays"], camera: Camera
) -> Float[Array, ""]:
    """The standard deviation of the sights of an object, from differences of the third order along rows and columns,
    which surfaces that bend little leave at zero; zero where there are none."""
    images = jnp.where(is_object, sight.reshape(-1), jnp.nan).reshape(-1, camera.height, camera.width)
    changes = [jnp.diff(images, 3, axis=axis).reshape(-1) for axis in (1, 2)]
    # The coefficients 1, 3, 3, 1 sum to 20 in squares.
    quartile = jnp.nanquantile(jnp.abs(jnp.concatenate(changes)), 0.25)
    return jnp.nan_to_num(_BY_QUARTILE / math.sqrt(20.0) * quartile)


@eqx.filter_jit
def evidence(bank: ShapeBank, hypotheses: Hypotheses, rays: Rays) -> tuple[Float[Array, " h"], Float[Array, ""]]:
    """L of each hypothesis, and L_0."""
    points = rays.origins + jnp.where(rays.is_object, rays.sight, 0.0)[:, None] * rays.directions

    def of_part(one):
        solid = bank.shape(one.shape).solid

        def distance(x):
            return one.placement.distance(solid, x)

        off = jnp.where(rays.is_object, misfit_of(distance(points), rays.tau), 0.0)
        through, counts = _deepest(distance, rays)
        through = jnp.where(counts, misfit_of(through, rays.tau), 0.0)
        return jnp.sum(rays.weight * jnp.where(rays.sight > 0, off + through, 0.0)), off

    misfits, off = jax.lax.map(of_part, hypotheses, batch_size=8)
    met = jnp.where(rays.is_object, rays.weight, 0.0)
    stray = jnp.sum(met * jnp.maximum(jnp.min(off, axis=0) - _NONE_MISFIT, 0.0))
    return misfits, _NONE_MISFIT * jnp.sum(met) + jnp.minimum(stray, _STRAY * MOST * jnp.sum(met))


def weight_of(away: Float[Array, ""], camera: Camera) -> Float[Array, ""]:
    """How many independent rays a camera's ray stands for, so far from an object: its area there by that within which
    rays err together."""
    across, down = camera.focal_lengths
    return away**2 / (across * down * _APART**2)


def misfit_of(distance: Float[Array, "*n"], tau: Float[Array, ""]) -> Float[Array, "*n"]:
    """l of a length in scene units, at most C."""
    return jnp.minimum(jnp.log1p(distance**2 / (2.0 * tau**2)), MOST)


def _deepest(
    distance: Callable[[Float[Array, "n 3"]], Float[Array, " n"]], rays: Rays
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """The least signed distance along each ray, short of what it met, zero where the ray passes beside the solid; and
    whether the ray is known to have gone there."""

    def stride(state, _):
        along, deepest, place = state
        here = distance(rays.origins + along[:, None] * rays.directions)
        is_deeper = (along < rays.sight - rays.tau) & (here < deepest)
        deepest, place = jnp.where(is_deeper, here, deepest), jnp.where(is_deeper, along, place)
        return (along + jnp.maximum(jnp.abs(here), _STRIDE), deepest, place), None

    zero = jnp.zeros_like(rays.sight)
    (_, deepest, place), _ = jax.lax.scan(stride, (zero, zero, zero), length=_NUM_STRIDES)
    points = rays.origins + place[:, None] * rays.directions
    node = jnp.round((points + rays.grid.half_extent) / rays.grid.spacing).astype(jnp.int32)
    node = jnp.where(jnp.all(node >= 0, axis=-1, keepdims=True), node, rays.grid.resolution)
    was_empty = rays.empty_nodes.at[tuple(node.T)].get(mode="fill", fill_value=False)
    return deepest, jnp.isfinite(rays.sight) | was_empty
