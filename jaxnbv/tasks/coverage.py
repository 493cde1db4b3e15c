"""Coverage: how much of the surface has been seen, and how much more a view would show."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, ImaginedView
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.neighbours import DistanceField, nearest_squared_distance, spacing
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning.metrics import GRAZING
from jaxnbv.sharding import on_cpu
from jaxnbv.utility import Quantity


def _many() -> int:
    """Scans at once, where little is computed of each."""
    return 128 if on_cpu() else 2048


class Coverage(Acquisition):
    """The paper's alpha^(CD): sum over the points x of the scan of min_{y in D} |x - y|^2, in squared scene units."""

    def context(self, step: StepInputs) -> PointCloud:
        """D itself."""
        return step.observations.cloud

    def score(self, context: PointCloud, view: ImaginedView) -> Float[Array, ""]:
        """Unidirectional Chamfer distance from the scan to D; zero for a scan that sees nothing."""
        return jnp.sum(jnp.where(view.scan.mask, nearest_squared_distance(view.scan.points, context), 0.0))

    @property
    def quantity(self) -> Quantity:
        meaning = "squared distances to the cloud, summed over an imagined scan, mean over posterior samples."
        return Quantity("expected coverage gain", "", meaning, length_power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once: the loop over D runs once for all of them."""
        return _many()


class NewSurface(Acquisition):
    """Expected new area: how much surface an imagined scan shows that is not near D, in squared scene units.

        alpha(D, scan) = sum_x a(x) clip(d(x, D) / s - 1, 0, 1),   s = max(size, spacing of D),

    over the hits x of the scan, where d is the distance to the nearest point of D, the spacing the median of how far
    its points are from their nearest neighbours, and a(x) = r^2 omega / cos the area of the pixel on the surface: omega
    its solid angle, r the distance, cos that of the angle of incidence, at least 0.2. The rays of one scan do not
    overlap, so no part of the surface counts twice; and neither near surfaces, which fill more pixels, nor a single
    point far from all others outweighs the rest, as in the paper's `Coverage`. It is differentiable in the pose
    wherever `Coverage` is.

    - `size`: what lies within this distance of D has been seen; what is twice as far is new. In scene units.

    **Raises:** `ValueError` if the size is not positive.
    """

    size: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        check_fields(self)
        require(self.size > 0, f"the size is {self.size}; it must be positive, in scene units")

    def context(self, step: StepInputs) -> DistanceField:
        """How far it is to D, in units of s, on a grid about it."""
        cloud = step.observations.cloud
        size = jnp.maximum(self.size, spacing(cloud))
        distance = DistanceField.of(cloud, 2.0 * size)
        return dataclasses.replace(distance, values=distance.values / size)

    def score(self, context: DistanceField, view: ImaginedView) -> Float[Array, ""]:
        """The new area of one scan; zero for a scan that sees nothing."""
        return jnp.sum(visible_area(view) * self.newness(context, view.scan.points))

    def newness(self, distance: DistanceField, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """From 0 beside D to 1 at 2 s."""
        return jnp.clip(distance(points) - 1.0, 0.0, 1.0)

    @property
    def quantity(self) -> Quantity:
        meaning = "area that an imagined scan shows and no scan has shown before, mean over posterior samples."
        return Quantity("expected new area", "", meaning, length_power=2)

    @property
    def batch_size(self) -> int:
        """Many scans at once."""
        return _many()


def visible_area(view: ImaginedView) -> Float[Array, " rays"]:
    """The area of each pixel on the surface that it shows, in squared scene units; zero where it shows none.

    A pixel of focal lengths fx and fy at depth z and distance r has r^2 omega = z^3 / (r fx fy).
    """
    scan, pose = view.scan, view.pose
    offset = jnp.where(scan.mask[:, None], scan.points - pose.position, pose.forward)
    depth = jnp.matmul(offset, pose.forward, precision="highest")
    distance = jnp.linalg.norm(offset, axis=-1)
    cosine = jnp.abs(jnp.sum(offset * scan.normals, axis=-1)) / distance
    across, down = view.camera.focal_lengths
    facing = depth**3 / (distance * across * down)
    return jnp.where(scan.mask, facing / jnp.maximum(cosine, GRAZING), 0.0)


def newness_of(acquisition: Acquisition) -> NewSurface:
    """What counts as new to an acquisition: itself, if it looks for new surface, or the default."""
    return acquisition if isinstance(acquisition, NewSurface) else NewSurface()


class ShownArea(Acquisition):
    """New area and all area of a scan: for `expected_value`, not for a search."""

    of: NewSurface

    def context(self, step: StepInputs) -> DistanceField:
        return self.of.context(step)

    def score(self, context: DistanceField, view: ImaginedView) -> Float[Array, "2"]:
        area = visible_area(view)
        return jnp.stack([jnp.sum(area * self.of.newness(context, view.scan.points)), jnp.sum(area)])

    @property
    def batch_size(self) -> int:
        return _many()
