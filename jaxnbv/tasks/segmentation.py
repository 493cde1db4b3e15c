"""Semantic parts: have all parts of the object been found?

A segmenter is any function p = segmenter(cloud) from a `PointCloud` (masked rows) to an array (points, parts): p_ic is
the probability that point i belongs to part c. Rows without a point hold zeros. There may be fewer rows than in the
cloud, if the segmenter thins it. `jaxnbv.networks.CloudSegmenter` wraps a network, and `HostSegmenter` a function
outside JAX. A `Segmenter` may also name its parts.
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

# Tolerance for the sums of probabilities in 32 bits or fewer.
_SLACK = 1e-2


class Segmenter(eqx.Module):
    """Base class of segmenters: part probabilities of each point. Subclasses must define `__call__` only.

    - `part_names`: names of the parts to find, by index, or None.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, "points parts"]:
        """p of one cloud (masked rows). Zeros in rows without a point."""

    @property
    def part_names(self) -> Mapping[int, str] | None:
        return None

    @property
    def batch_size(self) -> int:
        """Number of clouds to segment together."""
        return default_batch_size()


class FunctionSegmenter(Segmenter):
    """A segmenter from a plain function of a cloud."""

    function: Callable[[PointCloud], Float[Array, "points parts"]]

    # `SoftPartCount.check` checks the result.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)


def as_segmenter(value: Any) -> Segmenter:
    """The value itself if it is a segmenter, else a plain function wrapped as one.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Segmenter) else FunctionSegmenter(plain_function(value, "the segmenter"))


# A converter accepts plain functions too, which mypy cannot see.
if TYPE_CHECKING:
    AnySegmenter: TypeAlias = Any
else:
    AnySegmenter = Segmenter


class SoftPartCount(Utility):
    """Soft number of parts found, u_S(D) = sum_c tanh(sum_i p_ic / N_target).

    The paper's u_S, a utility for `ExpectedUtilityImprovement`. A part saturates once far more than N_target of its
    points are seen, so a view gains by showing parts that have not been found yet.

    - `segmenter`: a `Segmenter`, or a function from a cloud to part probabilities of each point.
    - `target`: N_target, in points that the segmenter gets. The default is the authors'.
    """

    segmenter: AnySegmenter = eqx.field(converter=as_segmenter)
    target: float = eqx.field(static=True, default=60.0)

    def __check_init__(self):
        check_fields(self)
        require(self.target > 0, f"N_target is {self.target}; it must be positive")

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """u_S(D), between zero and the number of parts."""
        return jnp.sum(jnp.tanh(jnp.sum(_probabilities(self.segmenter, cloud), axis=0) / self.target))

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` unless the segmenter returns probabilities, one row for each point."""
        with functions_of_users():
            p = _probabilities(self.segmenter, cloud)
        total = jnp.sum(p, axis=1)
        # Rows without a point hold zeros.
        proper = jnp.all(p >= -_SLACK) & jnp.all((jnp.abs(total - 1.0) < _SLACK) | (jnp.abs(total) < _SLACK))
        require(
            bool(proper),
            f"the segmenter gives values from {float(jnp.min(p)):.4g} whose sums over the parts run from "
            f"{float(jnp.min(total)):.4g} to {float(jnp.max(total)):.4g}: give probabilities, such as jax.nn.softmax "
            "of logits, and zeros for points that are not there",
        )

    @property
    def batch_size(self) -> int:
        """The segmenter's batch size."""
        return self.segmenter.batch_size

    @property
    def improvement(self) -> Quantity:
        """Name, unit and meaning of the expected improvement."""
        meaning = "how much an imagined scan raises the soft count of the parts, mean over posterior samples."
        return Quantity("expected gain in parts", "parts", meaning)

    def answer(self, cloud: PointCloud) -> "PartAnswer":
        """Number of points predicted for each part. Shows the segmenter's named parts, or else those found."""
        counts = np.asarray(self.answer_values(cloud), np.float64)
        part_names = self.segmenter.part_names
        names = tuple((part_names or {}).get(index, f"part {index}") for index in range(len(counts)))
        parts = tuple(np.flatnonzero(counts > 0).tolist() if part_names is None else part_names)
        return PartAnswer(names, counts, parts=parts, target=self.target)

    def answer_values(self, cloud: PointCloud) -> Float[Array, " parts"]:
        """Number of points predicted for each part."""
        return _counts(self.segmenter, cloud).astype(cloud.points.dtype)

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "PartAnswer":
        """Number of surface points of each part by the scene's labels.

        Without labels it is the answer on all of the surface. A part is present if it has at least one point.
        """
        answer = dataclasses.replace(self.answer(cloud), target=1.0)
        labels = scene.part_labels(cloud.points)
        if labels is None:
            return answer
        counts = np.bincount(np.asarray(labels)[np.asarray(cloud.mask)], minlength=len(answer.names))
        return dataclasses.replace(answer, values=counts[: len(answer.names)].astype(np.float64))


class PartAnswer(Answer):
    """Number of points predicted for each part.

    - `parts`: indices of the parts to show.
    - `target`: N_target.
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
    """N_c = sum_i 1[argmax_c' p_ic' = c], points predicted for each part. Zero rows do not count."""
    predicted = jax.nn.one_hot(jnp.argmax(p, axis=1), p.shape[1], dtype=jnp.int32)
    return jnp.sum(jnp.where(jnp.any(p > 0, axis=1)[:, None], predicted, 0), axis=0)
