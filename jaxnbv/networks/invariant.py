"""A small classifier that does not depend on how the object is turned."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import require
from jaxnbv.farthest import farthest_point_indices
from jaxnbv.networks.grouping import ball_query
from jaxnbv.networks.set_abstraction import product

_POOLED = 192


class InvariantClassifier(eqx.Module):
    """PointNet++ on point-pair features, which rotations and translations leave as they are.

    A pair of oriented points enters as (|d|^2, n_i . d, n_j . d, n_i . n_j) with d = (x_j - x_i) / radius: the
    point-pair features of Drost et al. (2010) without their square root and arc cosines, so that derivatives are
    defined everywhere. Two levels of grouping, at the scale of an edge and at that of a pattern, or a third for how
    these lie to each other, and a maximum over all groups; about 75,000 parameters, 150,000 with the third level.

    - `num_classes`, and their names `classes`, where known.
    - `radii`: of the levels, in the units of the points.
    - `groups`: how many each level has; more see more of what is small beside the rest.
    - `temperature`: divides the logits; above 1 it makes an over-confident network more careful (Guo et al. 2017).

    **Raises:** `ValueError` if the names are not as many as the classes, or there are not two or three levels, each
    with a radius and no more groups than the one before.
    """

    edge: "_Level"
    pattern: "_Level"
    whole: "_Level | None"
    head: tuple[eqx.nn.Linear, ...]
    temperature: Float[Array, ""]
    classes: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        num_classes: int,
        key: PRNGKeyArray,
        radii: tuple[float, ...] = (0.25, 0.8),
        classes: tuple[str, ...] | None = None,
        groups: tuple[int, ...] = (256, 64),
    ):
        named = num_classes if classes is None else len(classes)
        require(named == num_classes, f"{classes} names {named} classes; the network has {num_classes}")
        proper = len(radii) == len(groups) in (2, 3) and groups[-1] >= 1 and sorted(groups, reverse=True) == [*groups]
        require(
            proper and min(radii) > 0,
            f"the levels have radii {radii} and {groups} groups; give both for two levels or three, the radii positive "
            "and no level more groups than the one before",
        )
        edge_key, pattern_key, first_key, last_key = jax.random.split(key, 4)
        self.edge = _Level(0, 32, 64, radii[0], groups[0], 24, edge_key)
        self.pattern = _Level(64, 112, _POOLED, radii[1], groups[1], 48, pattern_key)
        whole_key = jax.random.fold_in(key, 0)
        self.whole = _Level(_POOLED, 160, _POOLED, radii[2], groups[2], 48, whole_key) if len(groups) == 3 else None
        self.head = (eqx.nn.Linear(_POOLED, _POOLED, key=first_key), eqx.nn.Linear(_POOLED, num_classes, key=last_key))
        self.temperature, self.classes = jnp.asarray(1.0), classes

    def __call__(
        self, points: Float[Array, "n 3"], normals: Float[Array, "n 3"], mask: Bool[Array, " n"] | None = None
    ) -> Float[Array, " classes"]:
        """Log-probabilities of the classes; the normals are unit. Masked rows do not matter."""
        mask = jnp.ones(len(points), bool) if mask is None else mask
        # In farthest point order the first rows are themselves farthest point samples of all.
        order = farthest_point_indices(points, mask, self.edge.groups)
        centers = points[order], normals[order]
        found = self.edge(centers, (points, normals, None), mask)
        for level in self.levels[1:]:
            finer, centers = centers, (centers[0][: level.groups], centers[1][: level.groups])
            found = level(centers, (*finer, found), jnp.ones(len(found), bool))
        pooled = jnp.where(jnp.any(mask), jnp.max(found, axis=0), 0.0)
        hidden, output = self.head
        return jax.nn.log_softmax(_affine(output, jax.nn.relu(_affine(hidden, pooled))) / self.temperature)

    @property
    def levels(self) -> tuple["_Level", ...]:
        """From the finest on."""
        return (self.edge, self.pattern) if self.whole is None else (self.edge, self.pattern, self.whole)


class _Level(eqx.Module):
    """One level of grouping: pair features and the neighbours' features through a perceptron, then the maximum."""

    pair: eqx.nn.Linear
    feature: eqx.nn.Linear | None
    output: eqx.nn.Linear
    radius: float = eqx.field(static=True)
    groups: int = eqx.field(static=True)
    neighbours: int = eqx.field(static=True)

    def __init__(self, inputs, width, outputs, radius, groups, neighbours, key):
        pair_key, feature_key, output_key = jax.random.split(key, 3)
        self.pair = eqx.nn.Linear(4, width, key=pair_key)
        self.feature = eqx.nn.Linear(inputs, width, use_bias=False, key=feature_key) if inputs else None
        self.output = eqx.nn.Linear(width, outputs, key=output_key)
        self.radius, self.groups, self.neighbours = radius, groups, neighbours

    def __call__(self, centers, neighbourhood, mask):
        points, normals, features = neighbourhood
        index = ball_query(centers[0], points, mask, self.radius, self.neighbours)
        d = (points[index] - centers[0][:, None]) / self.radius
        here, there = centers[1][:, None], normals[index]
        pairs = jnp.stack([jnp.sum(a * b, axis=-1) for a, b in ((d, d), (here, d), (there, d), (here, there))], axis=-1)
        hidden = _affine(self.pair, pairs.reshape(-1, 4))
        if self.feature is not None:
            # Linear, so the features meet their weights once a point rather than once a pair.
            hidden = hidden + product(features, self.feature.weight.T)[index].reshape(hidden.shape)
        output = _affine(self.output, jax.nn.relu(hidden))
        return jax.nn.relu(jnp.max(output.reshape(*index.shape, -1), axis=1))


def _affine(layer: Any, rows):
    return product(rows, layer.weight.T) + layer.bias
