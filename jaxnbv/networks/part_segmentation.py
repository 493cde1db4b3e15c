"""PointNet++ segmentation of one oriented point cloud into parts (Qi et al. 2017), in inference mode."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray, is_traced, require
from jaxnbv.networks.feature_propagation import FeaturePropagation
from jaxnbv.networks.pointnet2 import SINGLE_SCALE, Level
from jaxnbv.networks.set_abstraction import Linear, PooledMLP, SetAbstraction

# As published, for objects that are centred and fill the unit sphere.
PARTS_SINGLE_SCALE = SINGLE_SCALE
PARTS_MULTI_SCALE = (Level(512, (0.1, 0.2, 0.4), (32, 64, 128)), Level(128, (0.4, 0.8), (64, 128)))


class PointNet2PartSegmenter(eqx.Module):
    """From a cloud and its object's category to log-probabilities of parts, point by point.

    Set abstractions down to one vector, feature propagations back up to the points, then a perceptron. Expects the
    object centred and inside the unit sphere, as in training. Reverse-mode differentiable in points and normals; which
    points are sampled, grouped and taken as neighbours is fixed.

    - `levels`: the set abstractions.
    - `whole`: the PointNet over the last level's centres, coordinates and features.
    - `propagations`: the way back, the coarsest level first.
    - `hidden`: the perceptron's first layer, followed by a rectifier.
    - `last`: its last layer, one output a part.
    """

    levels: tuple[SetAbstraction, ...]
    whole: PooledMLP
    propagations: tuple[FeaturePropagation, ...]
    hidden: Linear
    last: Linear

    @property
    def num_parts(self) -> int:
        """The number of parts of all categories together."""
        return self.last.bias.shape[0]

    @property
    def num_categories(self) -> int:
        """The number of categories."""
        carried = self.propagations[-2].layers[-1].bias.shape[0]
        own = 3 + (6 if self.uses_normals else 3)
        return self.propagations[-1].layers[0].weight.shape[0] - carried - own

    @property
    def uses_normals(self) -> bool:
        """Whether the network was made for oriented points; one that was not ignores the normals."""
        return self.levels[0].branches[0].layers[0].weight.shape[0] == 9

    def __call__(
        self,
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        category: int | Int[AnyArray, ""] | Float[AnyArray, " categories"],
        mask: Bool[Array, " n"] | None = None,
    ) -> Float[Array, "n parts"]:
        """log p(part) at each point, over the parts of all categories; rows that `mask` does not name mean nothing.

        `category` is its index, which may be traced, or its one-hot vector. What stands in rows that are not named, and
        how many there are, does not matter to the others. The order of the filled rows does: the first is the first
        centre, and crowded balls are cut to their first rows.

        **Raises:** `ValueError` if points and normals are not both (n, 3), there are no rows, or there is no such
        category.
        """
        require(
            points.ndim == 2 and points.shape[1] == 3 and points.shape[0] > 0 and normals.shape == points.shape,
            f"points and normals must both be (n, 3) with n > 0, got {points.shape} and {normals.shape}: "
            "one cloud a call, many with jax.lax.map",
        )
        if mask is None:
            mask = jnp.ones(len(points), dtype=bool)
        points, normals = (jnp.where(mask[:, None], rows, 0.0) for rows in (points, normals))
        # The published network gives the coordinates as features too, beside those relative to a ball's centre.
        features = jnp.concatenate([points, normals], axis=-1) if self.uses_normals else points
        one_hot = jnp.broadcast_to(self._one_hot(category, points.dtype), (len(points), self.num_categories))
        own = [(points, jnp.concatenate([one_hot, points, features], axis=-1))]
        for level in self.levels:
            points, features = level(points, features, mask)
            mask = jnp.ones(len(points), dtype=bool)
            own.append((points, features))
        x = self.whole.pool(self.whole.lift(points, features))[None]
        coarse = jnp.zeros((1, 3), points.dtype)
        for (points, features), propagation in zip(reversed(own), self.propagations, strict=True):
            x, coarse = propagation(points, coarse, features, x), points
        return jax.nn.log_softmax(self.last(jax.nn.relu(self.hidden(x))), axis=-1)

    def _one_hot(self, category, dtype) -> Float[Array, " categories"]:
        count = self.num_categories
        if jnp.ndim(category) == 1:
            require(len(category) == count, f"the one-hot category has {len(category)} entries; expected {count}")
            return jnp.asarray(category, dtype)
        require(
            is_traced(category) or 0 <= int(category) < count,
            f"the category is {category}; the network knows 0 to {count - 1}",
        )
        return jax.nn.one_hot(category, count, dtype=dtype)
