"""From a network on arrays to the classifier or the segmenter of clouds that the tasks take."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxnbv.checks import AnyArray, check_fields, check_type, is_traced, require, shown
from jaxnbv.geometry.cloud import PointCloud, farthest_point_subsample
from jaxnbv.networks.categories import CATEGORIES, NUM_PARTS, category_index, part_mask
from jaxnbv.networks.invariant import InvariantClassifier
from jaxnbv.networks.pointnet2 import CompactPartSegmenter, PointNet2Classifier, PointNet2PartSegmenter
from jaxnbv.tasks.classification import Classifier
from jaxnbv.tasks.segmentation import Segmenter


class CloudClassifier(Classifier):
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


class CloudSegmenter(Segmenter):
    """A network as a function from a `PointCloud` to the probabilities of the parts of a known category, row by row.

    Category and scale are arrays, so objects that differ in them share one compilation.

    - `network`: called as `network(points, normals, category, mask)`; gives log-probabilities of the fifty parts of
      ShapeNet-part.
    - `category`: what the object is, by its name in `CATEGORIES` or its index there.
    - `num_points`: what the network is fed, by farthest point sampling; a smaller cloud is fed as it is, masked.
    - `scale`: network units per scene unit.

    **Raises:** `ValueError` for an unknown category, if `num_points` or `scale` is not positive, or for a network that
    classifies.
    """

    network: Callable[..., Float[Array, "n parts"]]
    category: Int[Array, ""]
    scale: Float[Array, ""]
    num_points: int = eqx.field(static=True)

    def __init__(
        self,
        network: Callable[..., Float[Array, "n parts"]],
        category: str | int | Int[AnyArray, ""],
        num_points: int = 2048,
        scale: float | Float[AnyArray, ""] = 1.0,
    ):
        check_type(network, Callable, "the network")
        check_type(num_points, int, "num_points")
        check_type(scale, float, "the scale")
        index = category_index(category) if isinstance(category, str) else category
        if not is_traced(index):
            index = index.item() if isinstance(index, AnyArray) and index.ndim == 0 else index
            check_type(index, int, "the category")
            known = bool(0 <= index < len(CATEGORIES))
            require(known, f"the category is {index}; choose 0 to {len(CATEGORIES) - 1}, or a name such as 'chair'")
        whole = isinstance(network, PointNet2Classifier | InvariantClassifier)
        require(not whole, "the network classifies whole clouds; a CloudClassifier feeds it clouds")
        require(num_points >= 1, f"num_points is {num_points}; the network needs at least one")
        require(is_traced(scale) or float(scale) > 0, f"the scale is {scale}; it must be positive")
        self.network, self.num_points = network, num_points
        self.category, self.scale = jnp.asarray(index, jnp.int32), jnp.asarray(scale, jnp.result_type(float))

    @property
    def part_names(self) -> dict[int, str]:
        """The parts of the category, by their index among the fifty."""
        category = CATEGORIES[int(self.category)]
        return dict(zip(category.labels, category.parts, strict=True))

    def __call__(self, cloud: PointCloud) -> Float[Array, "num_points parts"]:
        """p(part) at the points that are fed; exactly zero for parts of other categories, and in rows without a point.

        The network's probabilities, given that the part is one of the category's.
        """
        return self._probabilities(farthest_point_subsample(cloud, self.num_points))

    def predict(self, cloud: PointCloud) -> tuple[PointCloud, Int[Array, " num_points"]]:
        """The points that are fed, in scene coordinates, and the likeliest part of each; -1 in rows without a point."""
        fed = farthest_point_subsample(cloud, self.num_points)
        labels = jnp.argmax(self._probabilities(fed), axis=-1).astype(jnp.int32)
        return fed, jnp.where(fed.mask, labels, -1)

    def _probabilities(self, fed: PointCloud) -> Float[Array, "num_points parts"]:
        log_p = self.network(self.scale * fed.points, fed.normals, self.category, fed.mask)
        known = log_p.shape[-1]
        require(known == NUM_PARTS, f"the network knows {known} parts; give one that knows the 50 of ShapeNet-part")
        allowed = jnp.asarray(part_mask())[self.category]
        p = jax.nn.softmax(jnp.where(allowed, log_p, -jnp.inf), axis=-1)
        return jnp.where(fed.mask[:, None], p, 0.0)
