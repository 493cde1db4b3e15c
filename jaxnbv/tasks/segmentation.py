"""Semantic parts: have all parts of the object been found?

A segmenter is any function from a `PointCloud` (rows, masked) to the probabilities p_ic that point i belongs to part c,
with rows of zeros for points that are not there: p = segmenter(cloud), (points, parts). The points may be fewer than
the cloud's, where the segmenter thins it; `jaxnbv.networks.CloudSegmenter` makes one of a network, `HostSegmenter` of a
function outside JAX. A `Segmenter` may also name the parts that it is asked for.
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

from jaxnbv.checks import check_fields, functions_of_users, require, returned
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.scanning import Surface
from jaxnbv.utility import Answer, Quantity, Utility, default_batch_size, plain_function

# Of probabilities in 32 bits, or less.
_SLACK = 1e-2


class Segmenter(eqx.Module):
    """Probabilities of the parts of an object, point by point. Only `__call__` must be given.

    `part_names`: the parts that it is asked for, by their index; None where they have no names.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, "points parts"]:
        """p of one cloud (rows, masked); zeros in rows without a point."""

    @property
    def part_names(self) -> Mapping[int, str] | None:
        return None

    @property
    def batch_size(self) -> int:
        """How many clouds are segmented together."""
        return default_batch_size()


class FunctionSegmenter(Segmenter):
    """A plain function of a cloud as a segmenter."""

    function: Callable[[PointCloud], Float[Array, "points parts"]]

    # What it returns is checked by `SoftPartCount.check`, which names it.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)


def as_segmenter(value: Any) -> Segmenter:
    """A segmenter as it is; a plain function as one.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Segmenter) else FunctionSegmenter(plain_function(value, "the segmenter"))


# Functions are converted on the way in, which mypy cannot see.
if TYPE_CHECKING:
    AnySegmenter: TypeAlias = Any
else:
    AnySegmenter = Segmenter


class SoftPartCount(Utility):
    """The paper's u_S(D) = sum_c tanh(sum_i p_ic / N_target), a utility for `ExpectedUtilityImprovement`.

    A part of which far more than N_target points are seen adds nothing any more, so the value of a view is what it
    shows of parts not found yet.

    - `segmenter`: a `Segmenter`, or a function from a cloud to the probabilities of the parts, point by point.
    - `target`: N_target, in points that the segmenter looks at; the default is the authors'.
    """

    segmenter: AnySegmenter = eqx.field(converter=as_segmenter)
    target: float = eqx.field(static=True, default=60.0)

    def __check_init__(self):
        check_fields(self)
        require(self.target > 0, f"N_target is {self.target}; it must be positive")

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """u_S, between zero and the number of parts."""
        return jnp.sum(jnp.tanh(jnp.sum(_probabilities(self.segmenter, cloud), axis=0) / self.target))

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` if what the segmenter gives of the cloud are not probabilities, a row a point."""
        with functions_of_users():
            p = _probabilities(self.segmenter, cloud)
        total = jnp.sum(p, axis=1)
        # Rows of points that are not there hold zeros.
        proper = jnp.all(p >= -_SLACK) & jnp.all((jnp.abs(total - 1.0) < _SLACK) | (jnp.abs(total) < _SLACK))
        require(
            bool(proper),
            f"the segmenter gives values from {float(jnp.min(p)):.4g} whose sums over the parts run from "
            f"{float(jnp.min(total)):.4g} to {float(jnp.max(total)):.4g}: give probabilities, such as jax.nn.softmax "
            "of logits, and zeros for points that are not there",
        )

    @property
    def batch_size(self) -> int:
        """As the segmenter prefers."""
        return self.segmenter.batch_size

    @property
    def improvement(self) -> Quantity:
        """What its expected improvement is."""
        meaning = "how much an imagined scan raises the soft count of the parts, mean over posterior samples."
        return Quantity("expected gain in parts", "parts", meaning)

    def answer(self, cloud: PointCloud) -> "PartAnswer":
        """How many points are predicted of each part: of those that the segmenter names, or of those that it finds."""
        counts = np.asarray(self.answer_values(cloud), np.float64)
        known = self.segmenter.part_names
        names = tuple((known or {}).get(index, f"part {index}") for index in range(len(counts)))
        asked = tuple(np.flatnonzero(counts > 0).tolist() if known is None else known)
        return PartAnswer(names, counts, asked=asked, target=self.target)

    def answer_values(self, cloud: PointCloud) -> Float[Array, " parts"]:
        """How many points are predicted of each part."""
        return _counts(self.segmenter, cloud).astype(cloud.points.dtype)

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "PartAnswer":
        """Of a solid with labels, how many points of its surface belong to each; of others, the answer on all of it.
        One point is enough for a part to be there."""
        answer = dataclasses.replace(self.answer(cloud), target=1.0)
        labels = scene.part_labels(cloud.points)
        if labels is None:
            return answer
        counts = np.bincount(np.asarray(labels)[np.asarray(cloud.mask)], minlength=len(answer.names))
        return dataclasses.replace(answer, values=counts[: len(answer.names)].astype(np.float64))


class PartAnswer(Answer):
    """How many points are predicted of each part; `asked`: the parts that are shown; `target`: N_target."""

    form: str = "{:.0f}"
    asked: tuple[int, ...] = ()
    target: float = 60.0


@eqx.filter_jit
def _probabilities(segmenter: Segmenter, cloud: PointCloud) -> Any:
    return returned(segmenter(cloud), "the segmenter's answer", 2, "give probabilities (points, parts)")


@eqx.filter_jit
def _counts(segmenter: Segmenter, cloud: PointCloud) -> Int[Array, " parts"]:
    return part_counts(_probabilities(segmenter, cloud))


def part_counts(p: Float[Array, "points parts"]) -> Int[Array, " parts"]:
    """N_c = sum_i 1[argmax_c' p_ic' = c]: how many points are predicted to belong to each part; empty rows to none."""
    predicted = jax.nn.one_hot(jnp.argmax(p, axis=1), p.shape[1], dtype=jnp.int32)
    return jnp.sum(jnp.where(jnp.any(p > 0, axis=1)[:, None], predicted, 0), axis=0)
