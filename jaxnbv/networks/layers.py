"""The layers of PointNet++ (Qi et al. 2017).

Set abstraction maps points x_j with features f_j to features g_i of fewer points, the centres c_i,

    g_i = max over j in the ball of c_i of MLP(x_j - c_i, f_j),   c_i by farthest point sampling,

with one MLP per radius. The outputs of these MLPs are concatenated. Feature propagation interpolates the features f_j
of coarse points y_j at more points x,

    f(x) = sum_j w_j f_j / sum_j w_j,   w_j = 1 / (|x - y_j|^2 + 1e-8),   over the three nearest y_j.

At inference, batch normalisation is a fixed affine map. It is merged into the weights of the layer before it.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import require
from jaxnbv.geometry.farthest_points import farthest_point_indices

_WORD_BITS = 32
# Keeps w_j finite if a point and a coarse point coincide. The published value, in squared units of the points.
_SOFTENING = 1e-8


def product(x: Float[Array, "*rows inputs"], weight: Float[Array, "inputs outputs"]) -> Float[Array, "*rows outputs"]:
    """Return x @ weight in full precision, computed as one matrix product for all rows."""
    flat = jnp.matmul(x.reshape(-1, x.shape[-1]), weight, precision="highest")
    return flat.reshape(*x.shape[:-1], weight.shape[1])


class Linear(eqx.Module):
    """A linear layer, x W + b in full precision, with the matrix W (`weight`) and the vector b (`bias`)."""

    weight: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]

    def __call__(self, x: Float[Array, "*rows inputs"]) -> Float[Array, "*rows outputs"]:
        return product(x, self.weight) + self.bias


class PooledMLP(eqx.Module):
    """A PointNet: the same perceptron for all members of a group, then the maximum over the group.

    - `layers`: two or more layers, each followed by a rectifier. The first three inputs of the first layer are
      coordinates.
    """

    layers: tuple[Linear, ...]

    def lift(self, points: Float[Array, "n 3"], features: Float[Array, "n inputs"] | None) -> Float[Array, "n outputs"]:
        """Apply the first layer without its bias to each point. The result serves all groups of the point."""
        inputs = points if features is None else jnp.concatenate([points, features], axis=-1)
        return product(inputs, self.layers[0].weight)

    def pool(self, lifted: Float[Array, "*groups members inputs"]) -> Float[Array, "*groups outputs"]:
        """Return the features of each group, from the results of `lift` for the members of the group."""
        hidden = jax.nn.relu(lifted + self.layers[0].bias)
        for layer in self.layers[1:-1]:
            hidden = jax.nn.relu(layer(hidden))
        # max relu(x + b) = relu(max x + b), so apply the last bias and rectifier once per group.
        last = self.layers[-1]
        return jax.nn.relu(jnp.max(product(hidden, last.weight), axis=-2) + last.bias)


class SetAbstraction(eqx.Module):
    """One level of PointNet++, with one perceptron per radius.

    - `branches`, `radii`: perceptrons, and radii of their balls in units of the points.
    - `members`: number of points in a group, for each radius.
    - `centers`: number of centres, each with one group per radius.
    """

    branches: tuple[PooledMLP, ...]
    radii: tuple[float, ...] = eqx.field(static=True)
    members: tuple[int, ...] = eqx.field(static=True)
    centers: int = eqx.field(static=True)

    def __call__(
        self, points: Float[Array, "n 3"], features: Float[Array, "n inputs"] | None, mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "centers 3"], Float[Array, "centers outputs"]]:
        """Return the centres and their features. Rows whose mask is False are ignored.

        If there are fewer points than centres, the first centre is repeated.
        """
        centers = points[farthest_point_indices(points, mask, self.centers)]
        outputs = []
        for branch, radius, members in zip(self.branches, self.radii, self.members, strict=True):
            index = ball_query(centers, points, mask, radius, members)
            # [x_j - c_i, f_j] W = [x_j, f_j] W - c_i W_x, where W_x are the rows of W for the coordinates.
            at_center = product(centers, branch.layers[0].weight[:3])
            outputs.append(branch.pool(branch.lift(points, features)[index] - at_center[:, None]))
        return centers, jnp.concatenate(outputs, axis=-1)


class FeaturePropagation(eqx.Module):
    """One level of feature propagation: interpolation, then one perceptron for all points.

    - `layers`: layers of the perceptron, each followed by a rectifier. Inputs of the first layer are the point's own
      features, then the interpolated features.
    """

    layers: tuple[Linear, ...]

    def __call__(
        self,
        points: Float[Array, "n 3"],
        coarse: Float[Array, "m 3"],
        own: Float[Array, "n inputs"],
        features: Float[Array, "m f"],
    ) -> Float[Array, "n outputs"]:
        """Return new features of the points, from their `own` features and the `features` of coarse points."""
        first = self.layers[0]
        # Interpolation is linear, so compute the first product at the coarse points, which are fewer.
        lifted = interpolate(points, coarse, product(features, first.weight[own.shape[1] :]))
        x = jax.nn.relu(product(own, first.weight[: own.shape[1]]) + lifted + first.bias)
        for layer in self.layers[1:]:
            x = jax.nn.relu(layer(x))
        return x


@functools.partial(jax.jit, static_argnames="count")
def ball_query(
    centers: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    radius: float | Float[Array, ""],
    count: int,
) -> Int[Array, "m count"]:
    """Return, for each centre, the indices of the first `count` rows of `points` within `radius`.

    Rows whose mask is False are ignored. A point at exactly `radius` is in the ball. If a ball has fewer points, its
    first index is repeated. If it has no point, all its indices are the first row whose mask is True.

    **Raises:** `ValueError` if `count` < 1.
    """
    require(count >= 1, f"cannot group {count} points; ask for at least one")
    centers, points = jax.lax.stop_gradient((centers, points))
    offsets = ((a[:, None] - b) ** 2 for a, b in zip(centers.T, points.T, strict=True))
    index = _positions_of_true((sum(offsets) <= radius**2) & mask, count)
    nearest = jnp.where(index[:, :1] < len(points), index[:, :1], jnp.argmax(mask).astype(index.dtype))
    return jnp.where(index < len(points), index, nearest)


def _positions_of_true(flags: Bool[Array, "m n"], count: int) -> Int[Array, "m count"]:
    """Return the columns of the first `count` true entries of each row.

    If a row has fewer true entries, the remaining results are at least n. Each row is packed into words of 32 bits. Bit
    counts give the word that holds the k-th true entry, and five bisections of this word give the bit. This takes one
    pass over the flags, but sorting would take many.
    """
    flags = jnp.pad(flags, ((0, 0), (0, -flags.shape[1] % _WORD_BITS))).reshape(len(flags), -1, _WORD_BITS)
    bit = jnp.left_shift(jnp.uint32(1), jnp.arange(_WORD_BITS, dtype=jnp.uint32))
    words = jnp.sum(jnp.where(flags, bit, jnp.uint32(0)), axis=-1, dtype=jnp.uint32)
    counts_through = jnp.cumsum(_bit_count(words), axis=1)

    ranks = jnp.arange(count, dtype=jnp.int32)
    word = jnp.sum(counts_through[:, None, :] <= ranks[:, None], axis=-1, dtype=jnp.int32)
    counts_before = jnp.where(word > 0, jnp.take_along_axis(counts_through, jnp.maximum(word - 1, 0), axis=1), 0)
    bits = jnp.take_along_axis(words, jnp.minimum(word, words.shape[1] - 1), axis=1)
    rank, column = ranks - counts_before, _WORD_BITS * word
    for half in (16, 8, 4, 2, 1):
        lower = _bit_count(bits & jnp.uint32((1 << half) - 1))
        above = lower <= rank
        rank = jnp.where(above, rank - lower, rank)
        bits = jnp.where(above, bits >> half, bits)
        column = jnp.where(above, column + half, column)
    return column


def _bit_count(words):
    return jax.lax.population_count(words).astype(jnp.int32)


def interpolate(
    points: Float[Array, "n 3"], coarse: Float[Array, "m 3"], features: Float[Array, "m f"]
) -> Float[Array, "n f"]:
    """Interpolate features at each point from its three nearest coarse points (all if fewer than three).

    Weights are inverse squared distances. The result is differentiable in all arguments. The derivative ignores that
    the nearest points may change.
    """
    index, is_valid = _nearest(points, coarse)
    squared = jnp.sum((points[:, None] - coarse[index]) ** 2, axis=-1)
    weights = jnp.where(is_valid, 1.0 / (squared + _SOFTENING), 0.0)
    weights = weights / jnp.sum(weights, axis=1, keepdims=True)
    return jnp.sum(weights[..., None] * features[index], axis=1)


def _nearest(points: Float[Array, "n 3"], coarse: Float[Array, "m 3"]) -> tuple[Int[Array, "n 3"], Bool[Array, "n 3"]]:
    """Return the rows of the three coarse points nearest to each point, and a mask.

    If there are fewer than three coarse points, the mask is False for the missing ones.
    On a CPU this loop over the coarse points is two to three times as fast as `jax.lax.top_k`.
    """
    points, coarse = jax.lax.stop_gradient((points, coarse))
    x, y, z = points.T

    def closer(row, best):
        (d1, d2, d3), (i1, i2, i3) = best
        a, b, c = coarse[row]
        d = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
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

    infinite, zeros = jnp.full(len(points), jnp.inf, points.dtype), jnp.zeros(len(points), jnp.int32)
    distances, rows = jax.lax.fori_loop(0, len(coarse), closer, ((infinite,) * 3, (zeros,) * 3), unroll=8)
    return jnp.stack(rows, axis=1), jnp.isfinite(jnp.stack(distances, axis=1))
