"""Semantic parts: have all parts of the object been found?

A segmenter is any function from a `PointCloud` (rows, masked) to the probabilities p_ic that point i belongs to part c,
with rows of zeros for points that are not there: p = segmenter(cloud), (points, parts). The points may be fewer than
the cloud's, where the segmenter thins it; `jaxnbv.networks.CloudSegmenter` makes one of a network.
"""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxnbv.acquisition import preferred_batch_size
from jaxnbv.checks import require
from jaxnbv.cloud import PointCloud

Segmenter: TypeAlias = Callable[[PointCloud], Float[Array, "points parts"]]


class SoftPartCount(eqx.Module):
    """The paper's u_S(D) = sum_c tanh(sum_i p_ic / N_target), a utility for `ExpectedUtilityImprovement`.

    A part of which far more than N_target points are seen adds nothing any more, so views are worth what they show of
    parts not found yet.

    - `segmenter`: a function from a cloud to the probabilities of the parts, point by point.
    - `target`: N_target, in points that the segmenter looks at; the default is the authors'.
    """

    segmenter: Segmenter
    target: float = eqx.field(static=True, default=60.0)

    def __check_init__(self):
        require(self.target > 0, f"N_target is {self.target}; it must be positive")

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """u_S, between zero and the number of parts."""
        return jnp.sum(jnp.tanh(jnp.sum(self.segmenter(cloud), axis=0) / self.target))

    @property
    def batch_size(self) -> int:
        """As the segmenter prefers."""
        return preferred_batch_size(self.segmenter)


def part_counts(p: Float[Array, "points parts"]) -> Int[Array, " parts"]:
    """N_c = sum_i 1[argmax_c' p_ic' = c]: how many points are predicted to belong to each part; empty rows to none."""
    predicted = jax.nn.one_hot(jnp.argmax(p, axis=1), p.shape[1], dtype=jnp.int32)
    return jnp.sum(jnp.where(jnp.any(p > 0, axis=1)[:, None], predicted, 0), axis=0)
