"""PointNet++ classification of one oriented point cloud (Qi et al. 2017), in inference mode."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import require
from jaxnbv.networks.set_abstraction import Linear, PooledMLP, SetAbstraction


class Level(NamedTuple):
    """How a set abstraction samples: centres, the balls' radii, and the rows of each ball's group."""

    centers: int
    radii: tuple[float, ...]
    members: tuple[int, ...]


# As published, for objects that are centred and fill the unit sphere.
SINGLE_SCALE = (Level(512, (0.2,), (32,)), Level(128, (0.4,), (64,)))
MULTI_SCALE = (Level(512, (0.1, 0.2, 0.4), (16, 32, 128)), Level(128, (0.2, 0.4, 0.8), (32, 64, 128)))


class PointNet2Classifier(eqx.Module):
    """From a cloud to log-probabilities of classes: set abstractions, a PointNet over what remains, a perceptron.

    Expects the object centred and inside the unit sphere, as in training. Many clouds are a `vmap` or a `lax.map`: on
    a CPU the latter is two to three times as fast, as one cloud's features stay in the cache. Reverse-mode
    differentiable in points and normals; which points are sampled and grouped is taken as fixed.

    - `levels`: the set abstractions.
    - `whole`: the PointNet over the last level's centres, coordinates and features.
    - `hidden`: layers of the perceptron, each followed by a rectifier.
    - `last`: its last layer, one output a class.
    """

    levels: tuple[SetAbstraction, ...]
    whole: PooledMLP
    hidden: tuple[Linear, ...]
    last: Linear

    @property
    def num_classes(self) -> int:
        """The number of classes."""
        return self.last.bias.shape[0]

    @property
    def uses_normals(self) -> bool:
        """Whether the network was made for oriented points; one that was not ignores the normals."""
        return self.levels[0].branches[0].layers[0].weight.shape[0] == 6

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " classes"]:
        """log p(class) of one cloud, its rows all filled or those that `mask` names.

        What stands in other rows, and how many there are, does not matter. The order of the filled rows does: the first
        is the first centre, and crowded balls are cut to their first rows. A cloud with no filled row is seen as one
        point at the origin.

        **Raises:** `ValueError` if points and normals are not both (n, 3), or there are no rows.
        """
        require(
            points.ndim == 2 and points.shape[1] == 3 and points.shape[0] > 0 and normals.shape == points.shape,
            f"points and normals must both be (n, 3) with n > 0, got {points.shape} and {normals.shape}: "
            "one cloud a call, many with jax.vmap",
        )
        if mask is None:
            mask = jnp.ones(len(points), dtype=bool)
        points, normals = (jnp.where(mask[:, None], rows, 0.0) for rows in (points, normals))
        features = normals if self.uses_normals else None
        for level in self.levels:
            points, features = level(points, features, mask)
            mask = jnp.ones(len(points), dtype=bool)
        x = self.whole.pool(self.whole.lift(points, features))
        for layer in self.hidden:
            x = jax.nn.relu(layer(x))
        return jax.nn.log_softmax(self.last(x))
