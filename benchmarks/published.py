"""Differences of the authors' published code from their paper, as methods of the studies.

    cd benchmarks
    jaxnbv study reconstruction --model paper --scenes 16 --methods coverage,farthest,random \
        --method published:mean_coverage
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv import Coverage, DiscreteSearch, Planner
from jaxnbv.acquisition import ImaginedView
from jaxnbv.geometry import NearestPoints
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.reconstruction import ReconstructionStudy


class MeanCoverage(Coverage):
    """Squared distances to the cloud, averaged over the points of a scan. The paper sums them."""

    def score(self, context: NearestPoints, view: ImaginedView) -> Float[Array, ""]:
        """Return the mean squared distance from the scan to D, which is zero for an empty scan."""
        return super().score(context, view) / jnp.maximum(view.scan.count, 1)


def mean_coverage(study: ReconstructionStudy, scene: Scene) -> Planner:
    """The study's planner with `MeanCoverage`."""
    return study.planner_of(MeanCoverage(), DiscreteSearch(study.candidates), scene)
