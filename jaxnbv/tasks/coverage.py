"""Geometric exploration: scan what is far from everything scanned so far."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, Quantity, expected_value
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.neighbours import nearest_squared_distance
from jaxnbv.tasks.stopping import SoFar, Stop


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
        return Quantity("expected coverage gain", "scene units²", meaning)

    @property
    def batch_size(self) -> int:
        """Many scans at once: the loop over D runs once for all of them."""
        return 128


class SeenBefore(Acquisition):
    """How many points an imagined scan has, and how many of them are near D: for `expected_value`, not for a search.

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


class Covered(Stop):
    """Stop once expected coverage reaches `share`.

    Of all points that the sensor would see of the sampled surfaces from the candidates, the share that lies near D. Of
    three objects it was right to 0.02 on one, and up to 0.28 too low on two: it ends late rather than early.

    - `share`: within (0, 1].
    - `radius`: within which of D a point counts as seen, in scene units.

    **Raises:** `ValueError` for another share, or a radius that is not positive.
    """

    share: float = eqx.field(static=True, default=0.98)
    radius: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.share <= 1, f"the share is {self.share}; it must lie within (0, 1]")
        SeenBefore(self.radius)

    def after(self, so_far: SoFar) -> str | None:
        covered = expected_coverage(so_far, self.radius)
        return f"{100 * covered:.1f} % of what can be seen is expected to be covered" if covered >= self.share else None


def expected_coverage(so_far: SoFar, radius: float = 0.05) -> float:
    """Share of what the camera would see of the posterior's surfaces, from all candidates, that lies near D.

    - `radius`: how near, in scene units.
    """
    surfaces = so_far.imagination.sample(so_far.evidence, so_far.key)
    barrier = so_far.imagination.barrier(so_far.camera, so_far.candidates)
    where = so_far.evidence.cloud, surfaces, so_far.camera, so_far.candidates, barrier
    near, seen = np.asarray(_values(SeenBefore(radius), *where)).sum(axis=0)
    return float(near / seen) if seen else 1.0


_values = eqx.filter_jit(expected_value)
