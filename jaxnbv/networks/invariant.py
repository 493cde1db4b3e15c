"""Small rotation-invariant classifiers, whose inputs are features of pairs of oriented points."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import require
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.layers import ball_query, interpolate, product

_POOLED_WIDTH = 192
# `Focus`: number of centres of its second level, and number of points that it chooses.
_NUM_CENTERS, _NUM_SELECTED = 384, 320


class PairLevel(eqx.Module):
    """One level of grouping: the features of each centre, computed from the neighbours in its group.

    A perceptron takes the pair features of a centre and a neighbour, and the neighbour's own features if there are any.
    The features of the centre are the maximum of the perceptron's outputs over the neighbours. The pair features of a
    centre with position x_i and normal n_i and a neighbour with x_j and n_j are (|d|^2, n_i . d, n_j . d, n_i . n_j)
    with d = (x_j - x_i) / radius. These are the point-pair features of Drost et al. (2010) without the square root and
    the arc cosines, so derivatives exist everywhere.

    - `radius`: radius of a group, in units of the points.
    - `groups`: number of centres that the caller should choose. This class does not use it.
    - `neighbours`: maximum number of points in a group. If more are within the radius, the first rows are used.
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
        """Return the features of each centre.

        - `centers`: positions and normals of the centres.
        - `neighbourhood`: positions, normals and features of the points from which neighbours are taken. Points whose
          `mask` is False are ignored.
        """
        points, normals, features = neighbourhood
        index = ball_query(centers[0], points, mask, self.radius, self.neighbours)
        d = (points[index] - centers[0][:, None]) / self.radius
        here, there = centers[1][:, None], normals[index]
        pairs = jnp.stack([jnp.sum(a * b, axis=-1) for a, b in ((d, d), (here, d), (there, d), (here, there))], axis=-1)
        hidden = _affine(self.pair, pairs.reshape(-1, 4))
        if self.feature is not None and features is not None:
            # The map is linear, so compute it once per point and not once per pair.
            hidden = hidden + product(features, self.feature.weight.T)[index].reshape(hidden.shape)
        output = _affine(self.output, jax.nn.relu(hidden))
        return jax.nn.relu(jnp.max(output.reshape(*index.shape, -1), axis=1))


def _affine(layer: Any, rows: Float[Array, "*rows inputs"]) -> Float[Array, "*rows outputs"]:
    return product(rows, layer.weight.T) + layer.bias


class Focus(eqx.Module):
    """A network that finds the cue: the points of an object that determine its class.

    For example, the cargo is the cue for the class of a truck. The network is invariant under rotations and
    translations, and has about 12,000 parameters. It computes features of each point's neighbourhood, groups them
    around farthest point samples, and interpolates the features of the groups back to the points. A perceptron maps
    both kinds of features of a point to the log-odds that the point is part of the cue.
    """

    edge: PairLevel
    around: PairLevel
    head: tuple[eqx.nn.Linear, ...]

    def __init__(self, key: PRNGKeyArray):
        edge_key, around_key, first_key, last_key = jax.random.split(key, 4)
        self.edge = PairLevel(0, 16, 32, 0.25, 0, 24, edge_key)
        self.around = PairLevel(32, 48, 48, 0.8, _NUM_CENTERS, 32, around_key)
        self.head = (eqx.nn.Linear(80, 48, key=first_key), eqx.nn.Linear(48, 1, key=last_key))

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> Float[Array, " n"]:
        """Return the log-odds that each point is part of the cue.

        Rows whose mask is False do not affect the other rows, and their own values have no meaning.
        """
        edges = self.edge((points, normals), (points, normals, None), mask)
        order = farthest_point_indices(points, mask, self.around.groups)
        around = self.around((points[order], normals[order]), (points, normals, edges), mask)
        carried = interpolate(points, points[order], around)
        first, last = self.head
        return _affine(last, jax.nn.relu(_affine(first, jnp.concatenate([edges, carried], axis=-1))))[:, 0]

    def select(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> tuple[Float[Array, "few 3"], Float[Array, "few 3"], Bool[Array, " few"]]:
        """Select the first 320 points that are part of the cue with a probability above 0.5.

        Returns points, normals, and a mask that is False for the remaining rows if fewer points are selected. If
        `points` are in farthest point order, the selected points are spread over the cue.
        """
        is_on_cue = mask & (self(points, normals, mask) > 0.0)
        index = jnp.argsort(~is_on_cue, stable=True)[:_NUM_SELECTED]
        return points[index], normals[index], is_on_cue[index]


class InvariantClassifier(eqx.Module):
    """PointNet++ on point-pair features, which are invariant under rotations and translations.

    The network has two levels of grouping (the first at the scale of an edge, the second at the scale of a pattern), a
    maximum over all groups, and about 75,000 parameters.

    - `radii`: radii of the two levels, in units of the points.
    - `classes`: names of the classes, or None.
    - `groups`: number of groups of each level. With more groups the network can use smaller details.
    - `focused`: whether a `Focus` first selects the points that the classifier gets.
    - `temperature`: number that divides the logits. A value above 1 makes an overconfident network less confident (Guo
      et al. 2017).

    **Raises:** `ValueError` if the number of names is not `num_classes`, if a radius is not positive, or if the second
    level has more groups than the first.
    """

    edge: PairLevel
    pattern: PairLevel
    head: tuple[eqx.nn.Linear, ...]
    temperature: Float[Array, ""]
    focus: Focus | None
    classes: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        num_classes: int,
        key: PRNGKeyArray,
        radii: tuple[float, float] = (0.25, 0.8),
        classes: tuple[str, ...] | None = None,
        groups: tuple[int, int] = (256, 64),
        focused: bool = False,
    ):
        num_names = num_classes if classes is None else len(classes)
        require(num_names == num_classes, f"{classes} names {num_names} classes; the network has {num_classes}")
        require(
            min(radii) > 0 and 1 <= groups[1] <= groups[0],
            f"the levels have radii {radii} and {groups} groups: give positive radii, and the second level no more "
            "groups than the first",
        )
        edge_key, pattern_key, first_key, last_key = jax.random.split(key, 4)
        self.edge = PairLevel(0, 32, 64, radii[0], groups[0], 24, edge_key)
        self.pattern = PairLevel(64, 112, _POOLED_WIDTH, radii[1], groups[1], 48, pattern_key)
        self.head = (
            eqx.nn.Linear(_POOLED_WIDTH, _POOLED_WIDTH, key=first_key),
            eqx.nn.Linear(_POOLED_WIDTH, num_classes, key=last_key),
        )
        self.focus = Focus(jax.random.fold_in(key, 1)) if focused else None
        self.temperature, self.classes = jnp.asarray(1.0), classes

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments of the constructor, except the key."""
        levels = self.edge, self.pattern
        return {
            "num_classes": self.head[1].out_features,
            "radii": tuple(level.radius for level in levels),
            "classes": self.classes,
            "groups": tuple(level.groups for level in levels),
            "focused": self.focus is not None,
        }

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " classes"]:
        """Return class log-probabilities. Normals must have unit length. Rows with a False mask are ignored."""
        mask = jnp.ones(len(points), bool) if mask is None else mask
        if self.focus is not None:
            points, normals, mask = self.focus.select(points, normals, mask)
        # The first rows in farthest point order are themselves farthest point samples, so use them as coarse centres.
        order = farthest_point_indices(points, mask, self.edge.groups)
        centers = points[order], normals[order]
        edges = self.edge(centers, (points, normals, None), mask)
        coarse = centers[0][: self.pattern.groups], centers[1][: self.pattern.groups]
        patterns = self.pattern(coarse, (*centers, edges), jnp.ones(len(order), bool))
        pooled = jnp.where(jnp.any(mask), jnp.max(patterns, axis=0), 0.0)
        hidden, output = self.head
        return jax.nn.log_softmax(_affine(output, jax.nn.relu(_affine(hidden, pooled))) / self.temperature)
