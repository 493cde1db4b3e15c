"""Evaluation of functions at the nodes of a cubic grid."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from jaxnbv.checks import AnyArray


def on_tensor_grid(
    function: Callable[[Float[Array, "n 3"]], Shaped[Array, "*s n"]], axis: Float[AnyArray, " g"]
) -> Shaped[Array, "*s g g g"]:
    """Return the values of a function at the nodes (x, y, z) of a grid, for all x, y and z in `axis`."""
    axis = jnp.asarray(axis)
    y, z = jnp.meshgrid(axis, axis, indexing="ij")

    # To save memory, evaluate the nodes of one x coordinate at a time.
    def slab(x):
        return function(jnp.stack([jnp.full_like(y, x), y, z], axis=-1).reshape(-1, 3))

    values = jnp.moveaxis(jax.lax.map(slab, axis), 0, -2)
    return values.reshape(*values.shape[:-1], *y.shape)
