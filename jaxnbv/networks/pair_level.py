"""What our own networks are made of: pairs of oriented points, which rotations and translations leave as they are."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.networks.grouping import ball_query
from jaxnbv.networks.set_abstraction import product


class PairLevel(eqx.Module):
    """One level of grouping: pair features and the neighbours' features through a perceptron, then the maximum.

    A pair of oriented points enters as (|d|^2, n_i . d, n_j . d, n_i . n_j) with d = (x_j - x_i) / radius: the
    point-pair features of Drost et al. (2010) without their square root and arc cosines, so that derivatives are
    defined everywhere.

    - `radius`: of a group, in the units of the points; it takes the first `neighbours` rows within.
    - `groups`: how many centres it is meant for; its user chooses them.
    """

    pair: eqx.nn.Linear
    feature: eqx.nn.Linear | None
    output: eqx.nn.Linear
    radius: float = eqx.field(static=True)
    groups: int = eqx.field(static=True)
    neighbours: int = eqx.field(static=True)

    def __init__(
        self, inputs: int, width: int, outputs: int, radius: float, groups: int, neighbours: int, key: PRNGKeyArray
    ):
        pair_key, feature_key, output_key = jax.random.split(key, 3)
        self.pair = eqx.nn.Linear(4, width, key=pair_key)
        self.feature = eqx.nn.Linear(inputs, width, use_bias=False, key=feature_key) if inputs else None
        self.output = eqx.nn.Linear(width, outputs, key=output_key)
        self.radius, self.groups, self.neighbours = radius, groups, neighbours

    def __call__(
        self,
        centers: tuple[Float[Array, "m 3"], Float[Array, "m 3"]],
        neighbourhood: tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "n inputs"] | None],
        mask: Bool[Array, " n"],
    ) -> Float[Array, "m outputs"]:
        """What is found around each centre, a point with its normal, of points with normals and features."""
        points, normals, features = neighbourhood
        index = ball_query(centers[0], points, mask, self.radius, self.neighbours)
        d = (points[index] - centers[0][:, None]) / self.radius
        here, there = centers[1][:, None], normals[index]
        pairs = jnp.stack([jnp.sum(a * b, axis=-1) for a, b in ((d, d), (here, d), (there, d), (here, there))], axis=-1)
        hidden = affine(self.pair, pairs.reshape(-1, 4))
        if self.feature is not None and features is not None:
            # Linear, so the features meet their weights once a point rather than once a pair.
            hidden = hidden + product(features, self.feature.weight.T)[index].reshape(hidden.shape)
        output = affine(self.output, jax.nn.relu(hidden))
        return jax.nn.relu(jnp.max(output.reshape(*index.shape, -1), axis=1))


def affine(layer: Any, rows: Float[Array, "*rows inputs"]) -> Float[Array, "*rows outputs"]:
    """A linear layer of all rows."""
    return product(rows, layer.weight.T) + layer.bias
