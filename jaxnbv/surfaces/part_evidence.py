"""How well placed parts explain what every ray of every view came back with, and what follows for their weights.

A ray that met the object at x, and came there through space that is empty, speaks of a placed part of signed distance d
by how far x is from its surface, and how deep the ray went through it:

    L = sum over views and rays of  l(d(x)) + l(min over the ray of min(d, 0)),   l(r) = log(1 + r^2 / 2 tau^2)

without the first term for a ray that did not meet the object. No term is more than C = l(0.3): what is far off says no
more than what is off; and none of a ray without a return is more than C_0 = -log 0.3, since dark surfaces return
nothing. A sum lets evidence add up, where a mean would not; but rays side by side err together, so it is tempered,

    w_h proportional to exp(-kappa L_h),   w_0 (none of these) to exp(-kappa N e_0),   N the rays that met the object.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.volume import Box, ray_interval
from jaxnbv.observations import Observations
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.surfaces.shape_bank import ShapeBank

# Scene units.
_TAU, _FAR = 0.03, 0.3
MOST = math.log1p(_FAR**2 / (2.0 * _TAU**2))
# A surface that faces a ray returns it with a probability of 0.7 or more.
_NO_RETURN = -math.log(0.3)
# The least stride along a ray, and how many are taken.
_STRIDE, _NUM_STRIDES = 0.04, 40
# All views together speak by so many rays, at most, and each as if it had a thousand.
_NUM_RAYS, RAYS_OF_VIEW = 4096, 1000.0
KAPPA, NONE_MISFIT = 0.08, 0.17


class Rays(NamedTuple):
    """What rays of the views so far came back with, in random order.

    - `sight`: how far each went, without end where nothing came back; zero for a row that holds none.
    - `is_object`: whether it met the object there.
    - `weight`: how many rays of a view of a thousand each stands for.
    """

    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]
    sight: Float[Array, " n"]
    is_object: Bool[Array, " n"]
    weight: Float[Array, ""]

    @classmethod
    @eqx.filter_jit
    def of(cls, observations: Observations, box: Box) -> "Rays | None":
        """Those that enter a box; None where the observations keep no looks."""
        looks, poses = observations.looks, observations.poses
        if looks is None:
            return None
        views, rays = looks.sight.shape
        origins, directions = (rows.reshape(-1, 3) for rows in looks.camera.rays(poses.rows))
        sight = looks.sight.reshape(-1)
        enter, leave = ray_interval(list(origins.T), list(directions.T), box.low, box.high)
        is_known = (sight > 0) & (leave > jnp.maximum(enter, 0.0))
        order = jnp.asarray(np.random.default_rng(0).permutation(views * rays))
        (rows,) = jnp.nonzero(is_known[order], size=_NUM_RAYS, fill_value=views * rays)
        chosen = order.at[rows].get(mode="fill", fill_value=0)
        sight = jnp.where(rows < views * rays, sight[chosen], 0.0)
        origins, directions = origins[chosen], directions[chosen]
        met = jnp.isfinite(sight) & (sight > 0)
        points = origins + jnp.where(met, sight, 0.0)[:, None] * directions
        is_object = met & (looks(points) <= looks.grid.spacing)
        share = jnp.maximum(jnp.sum(is_known) / _NUM_RAYS, 1.0)
        return cls(origins, directions, sight, is_object, share * RAYS_OF_VIEW / rays)

    def first(self, count: int) -> "Rays":
        """The first few, each of which stands for more."""
        rows = (leaf[:count] for leaf in self[:4])
        share = jnp.sum(self.sight > 0) / jnp.maximum(jnp.sum(self.sight[:count] > 0), 1)
        return Rays(*rows, self.weight * share)

    @property
    def num_met(self) -> Float[Array, ""]:
        """N."""
        return self.weight * jnp.sum(self.is_object)


@eqx.filter_jit
def evidence(bank: ShapeBank, hypotheses: Hypotheses, rays: Rays) -> Float[Array, " h"]:
    """L of each hypothesis."""
    points = rays.origins + jnp.where(rays.is_object, rays.sight, 0.0)[:, None] * rays.directions

    def of_part(one):
        solid = bank.shape(one.shape).solid

        def distance(x):
            return one.placement.distance(solid, x)

        off = jnp.where(rays.is_object, misfit_of(distance(points)), 0.0)
        through = misfit_of(_deepest(distance, rays))
        through = jnp.where(jnp.isfinite(rays.sight), through, jnp.minimum(through, _NO_RETURN))
        return rays.weight * jnp.sum(jnp.where(rays.sight > 0, off + through, 0.0))

    return jax.lax.map(of_part, hypotheses, batch_size=8)


def misfit_of(distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """l of a length in scene units, at most C."""
    return jnp.minimum(jnp.log1p(distance**2 / (2.0 * _TAU**2)), MOST)


def _deepest(distance: Callable[[Float[Array, "n 3"]], Float[Array, " n"]], rays: Rays) -> Float[Array, " n"]:
    """The least signed distance along each ray, short of what it met; zero where the ray passes beside the solid."""

    def stride(state, _):
        along, deepest = state
        here = distance(rays.origins + along[:, None] * rays.directions)
        deepest = jnp.minimum(deepest, jnp.where(along < rays.sight - _TAU, here, 0.0))
        return (along + jnp.maximum(jnp.abs(here), _STRIDE), deepest), None

    start = jnp.zeros_like(rays.sight), jnp.zeros_like(rays.sight)
    return jax.lax.scan(stride, start, length=_NUM_STRIDES)[0][1]
