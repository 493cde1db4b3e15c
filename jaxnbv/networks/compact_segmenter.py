"""A small part segmenter in the manner of PointNet++, quick enough for hundreds of imagined scans a step."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.networks.categories import CATEGORIES, NUM_PARTS
from jaxnbv.networks.layers import FeaturePropagation, Linear, PooledMLP, SetAbstraction


class CompactPartSegmenter(eqx.Module):
    """Two set abstractions, a maximum over all, and back to the points; about 100,000 parameters.

    For oriented points of upright objects that face one way, as in ShapeNet: coordinates enter as they are, beside
    those relative to a group's centre. Reverse-mode differentiable in points and normals; which points are sampled and
    grouped is taken as fixed.
    """

    fine: SetAbstraction
    coarse: SetAbstraction
    whole: PooledMLP
    to_coarse: FeaturePropagation
    to_fine: FeaturePropagation
    to_points: FeaturePropagation
    last: Linear

    def __init__(self, key: PRNGKeyArray):
        keys = iter(jax.random.split(key, 16))
        self.fine = SetAbstraction((PooledMLP(_layers(keys, 9, 32, 64)),), (0.2,), (24,), 256)
        self.coarse = SetAbstraction((PooledMLP(_layers(keys, 3 + 64, 64, 128)),), (0.5,), (24,), 64)
        self.whole = PooledMLP(_layers(keys, 3 + 128, 128, 192))
        self.to_coarse = FeaturePropagation(_layers(keys, 128 + 192 + len(CATEGORIES), 128))
        self.to_fine = FeaturePropagation(_layers(keys, 64 + 128, 96))
        self.to_points = FeaturePropagation(_layers(keys, 6 + 96, 64))
        (self.last,) = _layers(keys, 64, NUM_PARTS)

    def __call__(
        self,
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        category: Int[Array, ""] | int,
        mask: Bool[Array, " n"] | None = None,
    ) -> Float[Array, "n parts"]:
        """Log-probabilities of the fifty parts, point by point, for an object of a category of `CATEGORIES`.

        Points in units in which the object's longest side is 2; normals are unit. Masked rows do not matter, and what
        is said of them means nothing.
        """
        mask = jnp.ones(len(points), bool) if mask is None else mask
        own = jnp.where(mask[:, None], jnp.concatenate([points, normals], axis=-1), 0.0)
        points = own[:, :3]
        centers, fine = self.fine(points, own, mask)
        everywhere = jnp.ones(len(centers), bool)
        coarse_centers, coarse = self.coarse(centers, fine, everywhere)
        whole = self.whole.pool(self.whole.lift(coarse_centers, coarse))
        said = jnp.concatenate([whole, jax.nn.one_hot(category, len(CATEGORIES), dtype=whole.dtype)])
        coarse = self.to_coarse(coarse_centers, jnp.zeros((1, 3), points.dtype), coarse, said[None])
        fine = self.to_fine(centers, coarse_centers, fine, coarse)
        return jax.nn.log_softmax(self.last(self.to_points(points, centers, own, fine)))


def _layers(keys: Any, *widths: int) -> tuple[Linear, ...]:
    """Layers with the initial weights of He et al. (2015)."""
    normal = jax.nn.initializers.he_normal()
    return tuple(Linear(normal(next(keys), pair), jnp.zeros(pair[1])) for pair in itertools.pairwise(widths))
