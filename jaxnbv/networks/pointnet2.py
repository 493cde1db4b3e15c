"""PointNet++ classifier and part segmenter (Qi et al. 2017), and a small part segmenter.

The PointNet++ networks are for inference only. The small segmenter has similar layers, and is fast enough for hundreds
of imagined scans in each step.
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
    """Sizes of a set abstraction: number of centres, radii of the balls, group size for each radius."""

    centers: int
    radii: tuple[float, ...]
    members: tuple[int, ...]


# The published sizes, for objects that are centred and fill the unit sphere.
SINGLE_SCALE = (Level(512, (0.2,), (32,)), Level(128, (0.4,), (64,)))
MULTI_SCALE = (Level(512, (0.1, 0.2, 0.4), (16, 32, 128)), Level(128, (0.2, 0.4, 0.8), (32, 64, 128)))
SCALES = SINGLE_SCALE, MULTI_SCALE
PARTS_SCALES = SINGLE_SCALE, (Level(512, (0.1, 0.2, 0.4), (32, 64, 128)), Level(128, (0.4, 0.8), (64, 128)))


def _fill_masked(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Bool[Array, " n"]]:
    """Return points and normals with zeros in rows whose mask is False, and the mask (default: all True).

    **Raises:** `ValueError` if points and normals are not both (n, 3), or there are no rows.
    """
    require(
        points.ndim == 2 and points.shape[1] == 3 and points.shape[0] > 0 and normals.shape == points.shape,
        f"points and normals must both be (n, 3) with n > 0, got {points.shape} and {normals.shape}: "
        "one cloud a call, many with jax.lax.map",
    )
    mask = jnp.ones(len(points), dtype=bool) if mask is None else mask
    return jnp.where(mask[:, None], points, 0.0), jnp.where(mask[:, None], normals, 0.0), mask


def _encode(
    levels: tuple[SetAbstraction, ...],
    whole: PooledMLP,
    points: Float[Array, "n 3"],
    features: Float[Array, "n inputs"] | None,
    mask: Bool[Array, " n"],
) -> tuple[list[Any], Float[Array, " outputs"]]:
    """Return a pair (centres, features) for each level, and the features of the whole cloud."""
    outputs = []
    for level in levels:
        points, features = level(points, features, mask)
        mask = jnp.ones(len(points), dtype=bool)
        outputs.append((points, features))
    return outputs, whole.pool(whole.lift(points, features))


class PointNet2Classifier(eqx.Module):
    """Classifier of a cloud: set abstractions, a PointNet over the last centres, and a perceptron.

    The object must be centred and inside the unit sphere, as in training. For many clouds use `vmap` or `lax.map`. On a
    CPU `lax.map` is two to three times as fast, because the features of one cloud stay in the cache. The result is
    reverse-mode differentiable in points and normals. The derivative ignores changes in the sampling and grouping of
    points.

    - `whole`: the PointNet over the coordinates and features of the last level's centres.
    - `hidden`, `last`: the perceptron. Rectifiers follow the hidden layers. The last layer has one output per class.
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
        """Compute the log-probabilities of the classes for one cloud. Without a mask, all rows are points.

        Rows whose mask is False do not affect the result. The order of the other rows affects it: the first row is the
        first centre, and a ball with too many points keeps only its first rows. A cloud without points is treated like
        a single point at the origin.

        **Raises:** `ValueError` if points and normals are not both (n, 3), or there are no rows.
        """
        points, normals, mask = _fill_masked(points, normals, mask)
        _, x = _encode(self.levels, self.whole, points, normals if self.uses_normals else None, mask)
        for layer in self.hidden:
            x = jax.nn.relu(layer(x))
        return jax.nn.log_softmax(self.last(x))


class PointNet2PartSegmenter(eqx.Module):
    """Part segmenter of a cloud for an object of known category.

    Set abstractions reduce the cloud to one vector, feature propagations carry this vector back to the points, and a
    perceptron follows. The object must be centred and inside the unit sphere, as in training. The result is
    reverse-mode differentiable in points and normals. The derivative ignores changes in the sampling, grouping and
    neighbours of points.

    - `whole`: the PointNet over the coordinates and features of the last level's centres.
    - `propagations`: the feature propagations, the coarsest level first.
    - `hidden`, `last`: the perceptron. A rectifier follows the hidden layer. The last layer has one output per part.
    """

    levels: tuple[SetAbstraction, ...]
    whole: PooledMLP
    propagations: tuple[FeaturePropagation, ...]
    hidden: Linear
    last: Linear

    @property
    def num_categories(self) -> int:
        """Number of categories, from the shapes of the weights."""
        carried_width = self.propagations[-2].layers[-1].bias.shape[0]
        point_width = 3 + (6 if self.uses_normals else 3)
        return self.propagations[-1].layers[0].weight.shape[0] - carried_width - point_width

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
        """Compute the log-probabilities of the parts of all categories, at each point.

        Rows whose mask is False do not affect the other rows, and their own values have no meaning. The order of the
        other rows affects the result, see `PointNet2Classifier`.

        - `category`: index of the category, which may be traced.

        **Raises:** `ValueError` if points and normals are not both (n, 3), there are no rows, or there is no such
        category.
        """
        points, normals, mask = _fill_masked(points, normals, mask)
        count = self.num_categories
        require(
            is_traced(category) or 0 <= int(category) < count,
            f"the category is {category}; the network has 0 to {count - 1}",
        )
        # The published network takes coordinates relative to a ball's centre, and absolute coordinates as features.
        features = jnp.concatenate([points, normals], axis=-1) if self.uses_normals else points
        one_hot = jnp.broadcast_to(jax.nn.one_hot(category, count, dtype=points.dtype), (len(points), count))
        levels, x = _encode(self.levels, self.whole, points, features, mask)
        inputs = [(points, jnp.concatenate([one_hot, points, features], axis=-1)), *levels]
        x, coarse = x[None], jnp.zeros((1, 3), points.dtype)
        for (points, features), propagation in zip(reversed(inputs), self.propagations, strict=True):
            x, coarse = propagation(points, coarse, features, x), points
        return jax.nn.log_softmax(self.last(jax.nn.relu(self.hidden(x))), axis=-1)


class CompactPartSegmenter(eqx.Module):
    """Small part segmenter: set abstractions, a PointNet over the last centres, and feature propagations.

    The segmenter has about 100,000 parameters. Absolute coordinates are features, so all objects must be upright and
    face the same direction as ShapeNet's objects. The result is reverse-mode differentiable in points and normals. The
    derivative ignores changes in the sampling and grouping of points.
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
        """Compute the log-probabilities of the fifty parts at each point.

        - `points`, `normals`: points in units in which the object's longest side is 2, and unit normals.
        - `category`: index of the object's category in `CATEGORIES`.
        - `mask`: False for rows to ignore. The values of these rows have no meaning.
        """
        points, normals, mask = _fill_masked(points, normals, mask)
        inputs = jnp.concatenate([points, normals], axis=-1)
        levels, whole = _encode((self.fine, self.coarse), self.whole, points, inputs, mask)
        (centers, fine), (coarse_centers, coarse) = levels
        context = jnp.concatenate([whole, jax.nn.one_hot(category, len(CATEGORIES), dtype=whole.dtype)])
        coarse = self.to_coarse(coarse_centers, jnp.zeros((1, 3), points.dtype), coarse, context[None])
        fine = self.to_fine(centers, coarse_centers, fine, coarse)
        return jax.nn.log_softmax(self.last(self.to_points(points, centers, inputs, fine)))


def _layers(keys: Any, *widths: int) -> tuple[Linear, ...]:
    """Make a layer between each two consecutive widths, with random weights as in He et al. (2015)."""
    normal = jax.nn.initializers.he_normal()
    return tuple(Linear(normal(next(keys), pair), jnp.zeros(pair[1])) for pair in itertools.pairwise(widths))
