"""A small classifier that does not depend on how the object is turned."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxnbv.checks import require
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.pair_level import PairLevel, affine

_POOLED = 192


class InvariantClassifier(eqx.Module):
    """PointNet++ on point-pair features, which rotations and translations leave as they are.

    Two levels of grouping, at the scale of an edge and at that of a pattern, and a maximum over all groups; about
    75,000 parameters.

    - `num_classes`, and their names `classes`, where known.
    - `radii`: of the two levels, in the units of the points.
    - `groups`: how many each level has; more see more of what is small beside the rest.
    - `temperature`: divides the logits; above 1 it makes an over-confident network more careful (Guo et al. 2017).

    **Raises:** `ValueError` if the names are not as many as the classes, a radius is not positive, or the second level
    has more groups than the first.
    """

    edge: PairLevel
    pattern: PairLevel
    head: tuple[eqx.nn.Linear, ...]
    temperature: Float[Array, ""]
    classes: tuple[str, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        num_classes: int,
        key: PRNGKeyArray,
        radii: tuple[float, float] = (0.25, 0.8),
        classes: tuple[str, ...] | None = None,
        groups: tuple[int, int] = (256, 64),
    ):
        named = num_classes if classes is None else len(classes)
        require(named == num_classes, f"{classes} names {named} classes; the network has {num_classes}")
        require(
            min(radii) > 0 and 1 <= groups[1] <= groups[0],
            f"the levels have radii {radii} and {groups} groups: give positive radii, and the second level no more "
            "groups than the first",
        )
        edge_key, pattern_key, first_key, last_key = jax.random.split(key, 4)
        self.edge = PairLevel(0, 32, 64, radii[0], groups[0], 24, edge_key)
        self.pattern = PairLevel(64, 112, _POOLED, radii[1], groups[1], 48, pattern_key)
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
        edges = self.edge(centers, (points, normals, None), mask)
        coarse = centers[0][: self.pattern.groups], centers[1][: self.pattern.groups]
        patterns = self.pattern(coarse, (*centers, edges), jnp.ones(len(order), bool))
        pooled = jnp.where(jnp.any(mask), jnp.max(patterns, axis=0), 0.0)
        hidden, output = self.head
        return jax.nn.log_softmax(affine(output, jax.nn.relu(affine(hidden, pooled))) / self.temperature)
