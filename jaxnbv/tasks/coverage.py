"""Geometric exploration: scan what is far from everything scanned so far."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, Quantity
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.neighbours import nearest_squared_distance
from jaxnbv.sharding import on_cpu


class Coverage(Acquisition):
    """The paper's alpha^(CD): sum over the points x of the scan of min_{y in D} |x - y|^2, in squared scene units."""

    def context(self, cloud: PointCloud) -> PointCloud:
        """D itself."""
        return cloud

    def __call__(self, context: PointCloud, scan: PointCloud) -> Float[Array, ""]:
        """Unidirectional Chamfer distance from the scan to D; zero for a scan that sees nothing."""
        return jnp.sum(jnp.where(scan.mask, nearest_squared_distance(scan.points, context), 0.0))

    @property
    def quantity(self) -> Quantity:
        meaning = "squared distances to the cloud, summed over an imagined scan, mean over posterior samples."
        return Quantity("expected coverage gain", "scene units²", meaning, power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once: the loop over D runs once for all of them."""
        return 128 if on_cpu() else 2048
