"""PointNet++ classifier and part segmenter (Qi et al. 2017), and a small part segmenter.

PointNet++ is in inference mode. The small segmenter has similar layers, and is fast enough for hundreds of imagined
scans in each step.
"""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray, is_traced, require
from jaxnbv.networks.categories import CATEGORIES, NUM_PARTS
from jaxnbv.networks.layers import FeaturePropagation, Linear, PooledMLP, SetAbstraction


class Level(NamedTuple):
    """Sizes of a set abstraction: number of centres, radii of balls, number of rows in each group."""

    centers: int
    radii: tuple[float, ...]
    members: tuple[int, ...]


# The published sizes, for objects that are centred and fill the unit sphere.
SINGLE_SCALE = (Level(512, (0.2,), (32,)), Level(128, (0.4,), (64,)))
MULTI_SCALE = (Level(512, (0.1, 0.2, 0.4), (16, 32, 128)), Level(128, (0.2, 0.4, 0.8), (32, 64, 128)))
SCALES = SINGLE_SCALE, MULTI_SCALE
PARTS_SCALES = SINGLE_SCALE, (Level(512, (0.1, 0.2, 0.4), (32, 64, 128)), Level(128, (0.4, 0.8), (64, 128)))


def _filled(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Bool[Array, " n"]]:
    """Points and normals with zeros in masked rows, and the mask."""
    require(
        points.ndim == 2 and points.shape[1] == 3 and points.shape[0] > 0 and normals.shape == points.shape,
        f"points and normals must both be (n, 3) with n > 0, got {points.shape} and {normals.shape}: "
        "one cloud a call, many with jax.lax.map",
    )
    mask = jnp.ones(len(points), dtype=bool) if mask is None else mask
    return jnp.where(mask[:, None], points, 0.0), jnp.where(mask[:, None], normals, 0.0), mask


def _down(network: Any, rows: Any, mask: Bool[Array, " n"]) -> tuple[list[Any], Float[Array, " outputs"]]:
    """Centres and features of each level of a network, and the features of the whole cloud.

    - `rows`: points and their features.
    """
    levels = []
    for level in network.levels:
        rows = level(*rows, mask)
        mask = jnp.ones(len(rows[0]), dtype=bool)
        levels.append(rows)
    return levels, network.whole.pool(network.whole.lift(*rows))


class PointNet2Classifier(eqx.Module):
    """Classifier of a cloud: set abstractions, a PointNet over the last centres, and a perceptron.

    Expects the object centred and inside the unit sphere, as in training. For many clouds use `vmap` or `lax.map`. On
    a CPU the latter is two to three times as fast, since the features of one cloud stay in the cache. Reverse-mode
    differentiable in points and normals, with the sampling and grouping of points held fixed.

    - `levels`: the set abstractions.
    - `whole`: the PointNet over the last level's centres, coordinates and features.
    - `hidden`: layers of the perceptron, each followed by a rectifier.
    - `last`: its last layer, with one output for each class.
    """

    levels: tuple[SetAbstraction, ...]
    whole: PooledMLP
    hidden: tuple[Linear, ...]
    last: Linear

    @property
    def uses_normals(self) -> bool:
        """Whether the network uses normals. Otherwise it ignores them."""
        return self.levels[0].branches[0].layers[0].weight.shape[0] == 6

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " classes"]:
        """log p(class) of one cloud. All rows are points if `mask` is None.

        Masked rows have no influence. The order of the others has: the first row is the first centre, and crowded balls
        keep their first rows only. A cloud without points is treated as one point at the origin.

        **Raises:** `ValueError` if points and normals are not both (n, 3), or there are no rows.
        """
        points, normals, mask = _filled(points, normals, mask)
        _, x = _down(self, (points, normals if self.uses_normals else None), mask)
        for layer in self.hidden:
            x = jax.nn.relu(layer(x))
        return jax.nn.log_softmax(self.last(x))


class PointNet2PartSegmenter(eqx.Module):
    """Part segmenter of a cloud for an object of known category.

    Set abstractions reduce the cloud to one vector, feature propagations lead back to the points, and a perceptron
    follows. Expects the object centred and inside the unit sphere, as in training. Reverse-mode differentiable in
    points and normals, with the sampling, grouping and neighbours of points held fixed.

    - `levels`: the set abstractions.
    - `whole`: the PointNet over the last level's centres, coordinates and features.
    - `propagations`: the feature propagations, the coarsest level first.
    - `hidden`: the perceptron's first layer, followed by a rectifier.
    - `last`: its last layer, with one output for each part.
    """

    levels: tuple[SetAbstraction, ...]
    whole: PooledMLP
    propagations: tuple[FeaturePropagation, ...]
    hidden: Linear
    last: Linear

    @property
    def num_categories(self) -> int:
        """The number of categories, from the shapes of the weights."""
        carried = self.propagations[-2].layers[-1].bias.shape[0]
        own = 3 + (6 if self.uses_normals else 3)
        return self.propagations[-1].layers[0].weight.shape[0] - carried - own

    @property
    def uses_normals(self) -> bool:
        """Whether the network uses normals. Otherwise it ignores them."""
        return self.levels[0].branches[0].layers[0].weight.shape[0] == 9

    def __call__(
        self,
        points: Float[Array, "n 3"],
        normals: Float[Array, "n 3"],
        category: int | Int[AnyArray, ""],
        mask: Bool[Array, " n"] | None = None,
    ) -> Float[Array, "n parts"]:
        """log p(part) at each point, over the parts of all categories. The values of masked rows mean nothing.

        Masked rows have no influence on the others. The order of the others has: the first row is the first centre, and
        crowded balls keep their first rows only.

        - `category`: index of the category, which may be traced.

        **Raises:** `ValueError` if points and normals are not both (n, 3), there are no rows, or there is no such
        category.
        """
        points, normals, mask = _filled(points, normals, mask)
        count = self.num_categories
        require(
            is_traced(category) or 0 <= int(category) < count,
            f"the category is {category}; the network has 0 to {count - 1}",
        )
        # The published network also has the coordinates as features, in addition to those relative to a ball's centre.
        features = jnp.concatenate([points, normals], axis=-1) if self.uses_normals else points
        one_hot = jnp.broadcast_to(jax.nn.one_hot(category, count, dtype=points.dtype), (len(points), count))
        levels, x = _down(self, (points, features), mask)
        own = [(points, jnp.concatenate([one_hot, points, features], axis=-1)), *levels]
        x, coarse = x[None], jnp.zeros((1, 3), points.dtype)
        for (points, features), propagation in zip(reversed(own), self.propagations, strict=True):
            x, coarse = propagation(points, coarse, features, x), points
        return jax.nn.log_softmax(self.last(jax.nn.relu(self.hidden(x))), axis=-1)


class CompactPartSegmenter(eqx.Module):
    """Small part segmenter: two set abstractions, a maximum over all points, three propagations.

    It has about 100,000 parameters. It expects oriented points of upright objects that face one way, as in ShapeNet,
    since absolute coordinates are features too. Reverse-mode differentiable in points and normals, with the sampling
    and grouping of points held fixed.
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
        """Log-probabilities of the fifty parts at each point.

        - `points`: in units in which the object's longest side is 2.
        - `normals`: of length one.
        - `category`: index of the object's category in `CATEGORIES`.
        - `mask`: masked rows have no influence, and their values mean nothing.
        """
        mask = jnp.ones(len(points), bool) if mask is None else mask
        own = jnp.where(mask[:, None], jnp.concatenate([points, normals], axis=-1), 0.0)
        points = own[:, :3]
        centers, fine = self.fine(points, own, mask)
        everywhere = jnp.ones(len(centers), bool)
        coarse_centers, coarse = self.coarse(centers, fine, everywhere)
        whole = self.whole.pool(self.whole.lift(coarse_centers, coarse))
        context = jnp.concatenate([whole, jax.nn.one_hot(category, len(CATEGORIES), dtype=whole.dtype)])
        coarse = self.to_coarse(coarse_centers, jnp.zeros((1, 3), points.dtype), coarse, context[None])
        fine = self.to_fine(centers, coarse_centers, fine, coarse)
        return jax.nn.log_softmax(self.last(self.to_points(points, centers, own, fine)))


def _layers(keys: Any, *widths: int) -> tuple[Linear, ...]:
    """Layers of these widths with initial weights by He et al. (2015)."""
    normal = jax.nn.initializers.he_normal()
    return tuple(Linear(normal(next(keys), pair), jnp.zeros(pair[1])) for pair in itertools.pairwise(widths))
