"""Feature propagation: features of few points carried back to many (Qi et al. 2017).

f(x) = sum_j w_j f_j / sum_j w_j,   w_j = 1 / (|x - y_j|^2 + 1e-8),   over the three nearest y_j.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.networks.set_abstraction import Linear, product

_NEIGHBOURS = 3
# Keeps the weight finite where a point and a coarse point coincide; the published number, in units of the points.
_SOFTENING = 1e-8


def interpolate(
    points: Float[Array, "n 3"],
    coarse: Float[Array, "m 3"],
    features: Float[Array, "m f"],
    mask: Bool[Array, " m"] | None = None,
) -> Float[Array, "n f"]:
    """The features of the three nearest coarse points at each point, weighted by inverse squared distance.

    Where there are fewer coarse points, or `mask` names fewer, all of them; zero where there is none. What stands in
    rows that are not named does not matter. Differentiable in features and in both kinds of points; which are the
    nearest is taken as fixed.
    """
    if mask is None:
        mask = jnp.ones(len(coarse), dtype=bool)
    coarse, features = (jnp.where(mask[:, None], rows, 0.0) for rows in (coarse, features))
    index, is_found = _nearest(points, coarse, mask)
    squared = jnp.sum((points[:, None] - coarse[index]) ** 2, axis=-1)
    weights = jnp.where(is_found, 1.0 / (squared + _SOFTENING), 0.0)
    total = jnp.sum(weights, axis=1, keepdims=True)
    weights = weights / jnp.where(total > 0, total, 1.0)
    return jnp.sum(weights[..., None] * features[index], axis=1)


def _nearest(
    points: Float[Array, "n 3"], coarse: Float[Array, "m 3"], mask: Bool[Array, " m"]
) -> tuple[Int[Array, "n 3"], Bool[Array, "n 3"]]:
    """Rows of the three nearest coarse points, and whether there are as many.

    A loop over the coarse points that keeps the three best: on a CPU two to three times as fast as `jax.lax.top_k`.
    """
    points, coarse = jax.lax.stop_gradient((points, coarse))
    x, y, z = points.T
    far = jnp.where(mask, 0.0, jnp.inf)

    def closer(row, best):
        (d1, d2, d3), (i1, i2, i3) = best
        a, b, c = coarse[row]
        d = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 + far[row]
        first, second, third = d < d1, d < d2, d < d3
        distances = (
            jnp.where(first, d, d1),
            jnp.where(first, d1, jnp.where(second, d, d2)),
            jnp.where(second, d2, jnp.where(third, d, d3)),
        )
        rows = (
            jnp.where(first, row, i1),
            jnp.where(first, i1, jnp.where(second, row, i2)),
            jnp.where(second, i2, jnp.where(third, row, i3)),
        )
        return distances, rows

    none = (
        (jnp.full(len(points), jnp.inf, points.dtype),) * _NEIGHBOURS,
        (jnp.zeros(len(points), jnp.int32),) * _NEIGHBOURS,
    )
    distances, rows = jax.lax.fori_loop(0, len(coarse), closer, none, unroll=8)
    return jnp.stack(rows, axis=1), jnp.isfinite(jnp.stack(distances, axis=1))


class FeaturePropagation(eqx.Module):
    """One level of the way back: interpolation, then the same perceptron at every point.

    - `layers`: each followed by a rectifier. The first one's inputs are the point's own features, then what is
      interpolated.
    """

    layers: tuple[Linear, ...]

    def __call__(
        self,
        points: Float[Array, "n 3"],
        coarse: Float[Array, "m 3"],
        own: Float[Array, "n inputs"],
        features: Float[Array, "m f"],
        mask: Bool[Array, " m"] | None = None,
    ) -> Float[Array, "n outputs"]:
        """Features of the points, from their own features and those of the coarse points that `mask` names."""
        first = self.layers[0]
        # Interpolation is linear, so the first product is taken at the coarse points, which are fewer.
        lifted = interpolate(points, coarse, product(features, first.weight[own.shape[1] :]), mask)
        x = jax.nn.relu(product(own, first.weight[: own.shape[1]]) + lifted + first.bias)
        for layer in self.layers[1:]:
            x = jax.nn.relu(layer(x))
        return x
