"""Geometric exploration: scan what is far from everything scanned so far."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.acquisition import Score
from jaxnbv.answers import Quantity
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.neighbours import nearest_squared_distance


class Coverage(Score):
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
        return Quantity("expected coverage gain", "scene units²", meaning)

    @property
    def batch_size(self) -> int:
        """Many scans at once: the loop over D runs once for all of them."""
        return 128


class SeenBefore(Score):
    """How many points an imagined scan has, and how many of them are near D: for `expected_score`, not for a search.

    - `radius`: within which a point was seen before, in scene units.
    """

    radius: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        check_fields(self)
        require(self.radius > 0, f"the radius is {self.radius}; it must be positive, in scene units")

    def context(self, cloud: PointCloud) -> PointCloud:
        """D itself."""
        return cloud

    def __call__(self, context: PointCloud, scan: PointCloud) -> Float[Array, "2"]:
        """Points of the scan within the radius of D, and all."""
        near = scan.mask & (nearest_squared_distance(scan.points, context) <= self.radius**2)
        return jnp.stack([jnp.sum(near), jnp.sum(scan.mask)]).astype(scan.points.dtype)

    @property
    def batch_size(self) -> int:
        """As of `Coverage`."""
        return 128
