"""What the authors' published code does otherwise than their paper says, as methods of the studies.

    cd benchmarks
    jaxnbv study reconstruction --model paper --scenes 16 --methods coverage,farthest,random \
        --method published:mean_coverage
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv import Coverage, DiscreteSearch, Planner, PointCloud
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.reconstruction import ReconstructionStudy


class MeanCoverage(Coverage):
    """Squared distances to the cloud, averaged over the points of a scan where the paper sums them."""

    def __call__(self, context: PointCloud, scan: PointCloud) -> Float[Array, ""]:
        """Zero for a scan that sees nothing."""
        return super().__call__(context, scan) / jnp.maximum(scan.count, 1)


def mean_coverage(study: ReconstructionStudy, scene: Scene) -> Planner:
    """The study's coverage by the mean."""
    return study.planner_of(MeanCoverage(), DiscreteSearch(study.candidates), scene)
