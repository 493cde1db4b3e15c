"""From a network on arrays to the classifier of clouds that the acquisitions take."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float

from jaxnbv.checks import check_fields, require, shown
from jaxnbv.geometry.cloud import PointCloud, farthest_point_subsample
from jaxnbv.networks.compact_segmenter import CompactPartSegmenter
from jaxnbv.networks.pointnet2 import PointNet2PartSegmenter


class CloudClassifier(eqx.Module):
    """A network as a function from a `PointCloud` to log-probabilities.

    - `network`: called as `network(points, normals, mask)`.
    - `num_points`: what it is fed, by farthest point sampling; a smaller cloud is fed as it is, masked.
    - `scale`: network units per scene unit.
    - `classes`: their names, where known; by default the network's own.

    **Raises:** `ValueError` if `num_points` or `scale` is not positive, or for a network that segments parts.
    """

    network: Callable[..., Float[Array, " classes"]]
    num_points: int = eqx.field(static=True, default=1024)
    scale: float = eqx.field(static=True, default=1.0)
    classes: tuple[str, ...] | None = eqx.field(static=True, default=None)

    def __post_init__(self):
        if self.classes is None:
            self.classes = getattr(self.network, "classes", None)

    def __check_init__(self):
        check_fields(self)
        parts = isinstance(self.network, PointNet2PartSegmenter | CompactPartSegmenter)
        names = () if self.classes is None else self.classes
        proper = isinstance(names, tuple) and all(isinstance(name, str) for name in names)
        require(proper, f"the classes are {shown(self.classes)}; give a tuple of names")
        require(not parts, "the network segments parts; a CloudSegmenter feeds it clouds")
        require(self.num_points >= 1, f"num_points is {self.num_points}; the network needs at least one")
        require(self.scale > 0, f"the scale is {self.scale}; it must be positive")

    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """Log-probabilities of the classes of one cloud in scene coordinates."""
        fed = farthest_point_subsample(cloud, self.num_points)
        return self.network(self.scale * fed.points, fed.normals, fed.mask)
