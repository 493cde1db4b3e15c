"""Classifiers and segmenters of clouds, made from networks on arrays."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxnbv.checks import AnyArray, check_fields, check_type, is_traced, require, short_text
from jaxnbv.geometry.cloud import PointCloud, farthest_point_subsample
from jaxnbv.networks.categories import CATEGORIES, NUM_PARTS, category_index, part_mask
from jaxnbv.networks.invariant import InvariantClassifier
from jaxnbv.networks.pointnet2 import CompactPartSegmenter, PointNet2Classifier, PointNet2PartSegmenter
from jaxnbv.tasks.classification import Classifier
from jaxnbv.tasks.segmentation import Segmenter


class CloudClassifier(Classifier):
    """A classifier made from a network. It maps a `PointCloud` in scene coordinates to log-probabilities.

    - `network`: called as `network(points, normals, mask)`. It returns log-probabilities of the classes.
    - `num_points`: number of points that the network gets, selected by farthest point sampling. A smaller cloud is
      padded with rows whose mask is False.
    - `scale`: network units per scene unit.
    - `classes`: names of the classes, by default `network.classes` if the network has this attribute.

    **Raises:** `ValueError` if `num_points` or `scale` is not positive, or if the network segments parts.
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
        segments_parts = isinstance(self.network, PointNet2PartSegmenter | CompactPartSegmenter)
        names = () if self.classes is None else self.classes
        has_names = isinstance(names, tuple) and all(isinstance(name, str) for name in names)
        require(has_names, f"the classes are {short_text(self.classes)}; give a tuple of names")
        require(not segments_parts, "the network segments parts: give it to CloudSegmenter")
        require(self.num_points >= 1, f"num_points is {self.num_points}; the network needs at least one")
        require(self.scale > 0, f"the scale is {self.scale}; it must be positive")

    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        inputs = farthest_point_subsample(cloud, self.num_points)
        return self.network(self.scale * inputs.points, inputs.normals, inputs.mask)


class CloudSegmenter(Segmenter):
    """A segmenter made from a network. It maps a `PointCloud` to part probabilities at some of its points.

    Category and scale are arrays, so objects of different category or scale use the same compiled program.

    - `network`: called as `network(points, normals, category, mask)`. It returns log-probabilities of the fifty parts
      of ShapeNet-part.
    - `category`: name of the object's category, or its index in `CATEGORIES`.
    - `num_points`, `scale`: see `CloudClassifier`.

    **Raises:** `ValueError` for an unknown category, if `num_points` or `scale` is not positive, or if the network
    classifies whole clouds.
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
            is_valid = bool(0 <= index < len(CATEGORIES))
            require(is_valid, f"the category is {index}; choose 0 to {len(CATEGORIES) - 1}, or a name such as 'chair'")
        classifies_clouds = isinstance(network, PointNet2Classifier | InvariantClassifier)
        require(not classifies_clouds, "the network classifies whole clouds: give it to CloudClassifier")
        require(num_points >= 1, f"num_points is {num_points}; the network needs at least one")
        require(is_traced(scale) or float(scale) > 0, f"the scale is {scale}; it must be positive")
        self.network, self.num_points = network, num_points
        self.category, self.scale = jnp.asarray(index, jnp.int32), jnp.asarray(scale, jnp.result_type(float))

    @property
    def part_names(self) -> dict[int, str]:
        """Names of the category's parts, keyed by their index among the fifty parts."""
        category = CATEGORIES[int(self.category)]
        return dict(zip(category.labels, category.parts, strict=True))

    def __call__(self, cloud: PointCloud) -> Float[Array, "num_points parts"]:
        """Return the probability of each part (axis 1) at each point that the network gets (axis 0).

        Parts of other categories have probability zero. If the cloud has fewer than `num_points` points, the last rows
        are zero. Each other row sums to one.
        """
        return self._probabilities(farthest_point_subsample(cloud, self.num_points))

    def predict(self, cloud: PointCloud) -> tuple[PointCloud, Int[Array, " num_points"]]:
        """Return the points that the network gets, and the most probable part of each (-1 in unfilled rows)."""
        inputs = farthest_point_subsample(cloud, self.num_points)
        labels = jnp.argmax(self._probabilities(inputs), axis=-1).astype(jnp.int32)
        return inputs, jnp.where(inputs.mask, labels, -1)

    def _probabilities(self, inputs: PointCloud) -> Float[Array, "num_points parts"]:
        log_p = self.network(self.scale * inputs.points, inputs.normals, self.category, inputs.mask)
        count = log_p.shape[-1]
        require(count == NUM_PARTS, f"the network has {count} parts; give one with the 50 parts of ShapeNet-part")
        is_allowed = jnp.asarray(part_mask())[self.category]
        p = jax.nn.softmax(jnp.where(is_allowed, log_p, -jnp.inf), axis=-1)
        return jnp.where(inputs.mask[:, None], p, 0.0)
