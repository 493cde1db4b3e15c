"""Set abstraction: from points with features to fewer points with features of their surroundings (Qi et al. 2017).

    g_i = max over j in the ball of c_i of MLP(x_j - c_i, f_j),   c_i by farthest point sampling,

one MLP a radius, their outputs side by side. Weights are those of inference: batch normalisation is an affine map with
fixed numbers there and is part of the layer before it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.grouping import ball_query


class Linear(eqx.Module):
    """x W + b in full precision.

    - `weight`: W, inputs by outputs.
    - `bias`: b.
    """

    weight: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]

    def __call__(self, x: Float[Array, "*rows inputs"]) -> Float[Array, "*rows outputs"]:
        """x W + b, row by row."""
        return product(x, self.weight) + self.bias


class PooledMLP(eqx.Module):
    """The same perceptron at each member of a group, then the maximum over the group: PointNet.

    - `layers`: two or more, each followed by a rectifier. The first one's leading three inputs are coordinates.
    """

    layers: tuple[Linear, ...]

    def lift(self, points: Float[Array, "n 3"], features: Float[Array, "n inputs"] | None) -> Float[Array, "n outputs"]:
        """[x, f] W of the first layer, without its bias: linear, so it is taken once a point and not once a group."""
        inputs = points if features is None else jnp.concatenate([points, features], axis=-1)
        return product(inputs, self.layers[0].weight)

    def pool(self, lifted: Float[Array, "*groups members inputs"]) -> Float[Array, "*groups outputs"]:
        """What follows the first product: rectifiers, the other layers and the maximum over the members."""
        hidden = jax.nn.relu(lifted + self.layers[0].bias)
        for layer in self.layers[1:-1]:
            hidden = jax.nn.relu(layer(hidden))
        # max relu(x + b) = relu(max x + b): the last bias and rectifier need not see every member.
        last = self.layers[-1]
        return jax.nn.relu(jnp.max(product(hidden, last.weight), axis=-2) + last.bias)


class SetAbstraction(eqx.Module):
    """One level of PointNet++, with a perceptron for each radius.

    - `branches`: the perceptron of each radius.
    - `radii`: of the balls, in units of the points.
    - `members`: rows in each ball's group.
    - `centers`: how many centres are chosen.
    """

    branches: tuple[PooledMLP, ...]
    radii: tuple[float, ...] = eqx.field(static=True)
    members: tuple[int, ...] = eqx.field(static=True)
    centers: int = eqx.field(static=True)

    def __call__(
        self, points: Float[Array, "n 3"], features: Float[Array, "n inputs"] | None, mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "centers 3"], Float[Array, "centers outputs"]]:
        """The centres, all filled (repeated where fewer points are), and what was found around each."""
        centers = points[farthest_point_indices(points, mask, self.centers)]
        outputs = []
        for branch, radius, members in zip(self.branches, self.radii, self.members, strict=True):
            index = ball_query(centers, points, mask, radius, members)
            # [x_j - c_i, f_j] W = [x_j, f_j] W - c_i W_x
            at_center = product(centers, branch.layers[0].weight[:3])
            outputs.append(branch.pool(branch.lift(points, features)[index] - at_center[:, None]))
        return centers, jnp.concatenate(outputs, axis=-1)


def product(x: Float[Array, "*rows inputs"], weight: Float[Array, "inputs outputs"]) -> Float[Array, "*rows outputs"]:
    """x W in full precision, as one matrix product of all rows."""
    flat = jnp.matmul(x.reshape(-1, x.shape[-1]), weight, precision="highest")
    return flat.reshape(*x.shape[:-1], weight.shape[1])
