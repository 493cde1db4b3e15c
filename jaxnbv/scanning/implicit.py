"""How a hit moves with the ray and the surface: the implicit function theorem, once for every kind of surface."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


@eqx.filter_custom_jvp
def implicit_depth(
    along: Callable[[Float[Array, " n"]], Float[Array, " n"]],
    depth: Float[Array, " n"],
    mask: Bool[Array, " n"],
    grazing: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The depths t at which n rays meet a surface, as differentiable functions of whatever `along` holds.

    - `along`: a module that gives f at a depth along every ray; its arrays are what hits are differentiated in.
    - `depth`: the roots, f = 0, however they were found; they come back as they are.
    - `mask`: which rays hit; the others have derivative zero.
    - `grazing`: smaller slopes |df/dt| are held at this value, their sign kept: where a ray runs along the surface the
      derivative of its hit is unbounded.

    From f(theta, t(theta)) = 0 follows dt = -(df/dtheta dtheta) / (df/dt). The rule is applied to itself for
    derivatives of higher order.
    """
    return depth


@implicit_depth.def_jvp
def _implicit_depth_jvp(primals, tangents):
    along, depth, mask, grazing = primals
    depth = implicit_depth(along, depth, mask, grazing)
    _, slope = jax.jvp(along, (depth,), (jnp.ones_like(depth),))
    slope = jnp.where(jnp.abs(slope) < grazing, jnp.where(slope < 0, -grazing, grazing), slope)
    _, change = eqx.filter_jvp(lambda field: field(depth), (along,), (tangents[0],))
    return depth, jnp.where(mask, -change / jnp.where(slope == 0, 1.0, slope), 0.0)
