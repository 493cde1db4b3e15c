"""Semantic parts: have all parts of the object been found?

A segmenter is any function p = segmenter(cloud) from a `PointCloud` to an array (points, parts). p_ic is the
probability that point i belongs to part c, and zero in rows without a point (the cloud's mask is False). The array has
fewer rows than the cloud if the segmenter thins the cloud. `jaxnbv.networks.CloudSegmenter` wraps a network, and
`HostSegmenter` wraps a function that runs outside JAX. A `Segmenter` may also name its parts.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.checks import check_fields, checked_result, functions_of_users, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.programs import program
from jaxnbv.scanning import Surface
from jaxnbv.utility import Answer, Quantity, Utility, default_batch_size, plain_function

# Tolerance for probabilities and their sums, which have 32 bits or fewer.
_SLACK = 1e-2


class Segmenter(eqx.Module):
    """Base class of segmenters of clouds. Subclasses must define only `__call__`.

    - `part_names`: names of the parts to find, keyed by the index of the part; None if parts have no names.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, "points parts"]:
        """Return the part probabilities of each point of one cloud, and zeros in rows whose mask is False."""

    @property
    def part_names(self) -> Mapping[int, str] | None:
        return None

    @property
    def batch_size(self) -> int:
        """Number of clouds to segment together."""
        return default_batch_size()


class FunctionSegmenter(Segmenter):
    """A segmenter that calls a plain function of a cloud."""

    function: Callable[[PointCloud], Float[Array, "points parts"]]

    # `SoftPartCount.check` checks the result.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)


def as_segmenter(value: Any) -> Segmenter:
    """Return a segmenter unchanged, or a plain function wrapped as a segmenter.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Segmenter) else FunctionSegmenter(plain_function(value, "the segmenter"))


# Fields of this type have a converter for plain functions. mypy does not know about converters.
if TYPE_CHECKING:
    AnySegmenter: TypeAlias = Any
else:
    AnySegmenter = Segmenter


class SoftPartCount(Utility):
    """Soft number of detected parts, u_S(D) = sum_c tanh(sum_i p_ic / N_target).

    This is the paper's u_S, a utility for `ExpectedUtilityImprovement`. p_ic is the probability that point i of the
    cloud D belongs to part c. The term of a part saturates once D has many more than N_target points of this part.
    Therefore the utility improves most with views that show new parts.

    - `segmenter`: a `Segmenter`, or a function from a cloud to part probabilities of each point.
    - `target`: N_target, a number of points after the segmenter's own thinning. The default is the authors' value.
    """

    segmenter: AnySegmenter = eqx.field(converter=as_segmenter)
    target: float = eqx.field(static=True, default=60.0)

    def __check_init__(self):
        check_fields(self)
        require(self.target > 0, f"N_target is {self.target}; it must be positive")

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """Return the soft number of detected parts, which is between zero and the number of parts."""
        return jnp.sum(jnp.tanh(jnp.sum(_probabilities(self.segmenter, cloud), axis=0) / self.target))

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` unless the segmenter returns a row of probabilities for each point."""
        with functions_of_users():
            p = _probabilities(self.segmenter, cloud)
        total = jnp.sum(p, axis=1)
        # Rows without a point contain zeros.
        is_proper = jnp.all(p >= -_SLACK) & jnp.all((jnp.abs(total - 1.0) < _SLACK) | (jnp.abs(total) < _SLACK))
        require(
            bool(is_proper),
            f"the segmenter gives values from {float(jnp.min(p)):.4g} whose sums over the parts run from "
            f"{float(jnp.min(total)):.4g} to {float(jnp.max(total)):.4g}: give probabilities, such as jax.nn.softmax "
            "of logits, and zeros for points that are not there",
        )

    @property
    def batch_size(self) -> int:
        return self.segmenter.batch_size

    @property
    def improvement(self) -> Quantity:
        meaning = "how much an imagined scan raises the soft count of the parts, mean over posterior samples."
        return Quantity("expected gain in parts", "parts", meaning)

    def answer(self, cloud: PointCloud) -> "PartAnswer":
        """Return the number of points that are predicted to belong to each part.

        The parts to show are the segmenter's named parts. Without names, all parts that have a point are shown.
        """
        counts = np.asarray(self.answer_values(cloud), np.float64)
        part_names = self.segmenter.part_names
        names = tuple((part_names or {}).get(index, f"part {index}") for index in range(len(counts)))
        parts = tuple(np.flatnonzero(counts > 0).tolist() if part_names is None else part_names)
        return PartAnswer(names, counts, parts=parts, target=self.target)

    def answer_values(self, cloud: PointCloud) -> Float[Array, " parts"]:
        """Return the number of points that are predicted to belong to each part."""
        return _counts(self.segmenter, cloud).astype(cloud.points.dtype)

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "PartAnswer":
        """Return the number of surface points of each part, from the scene's labels or else the segmenter.

        The answer's `target` is 1, because one point is enough to show that the object has the part.

        - `cloud`: points on the whole surface.
        """
        answer = dataclasses.replace(self.answer(cloud), target=1.0)
        labels = scene.part_labels(cloud.points)
        if labels is None:
            return answer
        counts = np.bincount(np.asarray(labels)[np.asarray(cloud.mask)], minlength=len(answer.names))
        return dataclasses.replace(answer, values=counts[: len(answer.names)].astype(np.float64))


class PartAnswer(Answer):
    """Number of points that are predicted to belong to each part.

    - `parts`: indices of the parts to show.
    - `target`: smallest number of points with which a part counts as found.
    """

    form: str = "{:.0f}"
    parts: tuple[int, ...] = ()
    target: float = 60.0


@program
def _probabilities(segmenter: Segmenter, cloud: PointCloud) -> Any:
    return checked_result(segmenter(cloud), "the segmenter's answer", 2, "give probabilities (points, parts)")


@program
def _counts(segmenter: Segmenter, cloud: PointCloud) -> Int[Array, " parts"]:
    return part_counts(_probabilities(segmenter, cloud))


def part_counts(p: Float[Array, "points parts"]) -> Int[Array, " parts"]:
    """Return the number of points for which each part is the most probable. Rows of zeros do not count."""
    predicted = jax.nn.one_hot(jnp.argmax(p, axis=1), p.shape[1], dtype=jnp.int32)
    return jnp.sum(jnp.where(jnp.any(p > 0, axis=1)[:, None], predicted, 0), axis=0)
