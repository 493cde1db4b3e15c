"""Classification: which class is the object of?

A classifier is any function from a `PointCloud` (rows, masked) to log-probabilities, log p = classifier(cloud): a
network of `jaxnbv.networks`, one of your own, or a `HostClassifier`. A `Classifier` may also name its classes.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, ImaginedView, context_of, zero_if_empty
from jaxnbv.checks import check_fields, require, returned
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import Surface
from jaxnbv.utility import Answer, Quantity, default_batch_size, plain_function

_LOG_P = "give log-probabilities, one for each of two classes or more"
# Their shape is checked by `Acquisition.check`.
Context: TypeAlias = tuple[PointCloud, Array]


class Classifier(eqx.Module):
    """Log-probabilities of the classes of a cloud. Only `__call__` must be given.

    `classes`: their names; None where they have none.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """log p of one cloud (rows, masked)."""

    @property
    def classes(self) -> tuple[str, ...] | None:
        return None

    @property
    def batch_size(self) -> int:
        """How many clouds are classified together."""
        return default_batch_size()


class FunctionClassifier(Classifier):
    """A plain function of a cloud as a classifier."""

    function: Callable[[PointCloud], Float[Array, " classes"]]

    # What it returns is checked by `Acquisition.check`, which names it.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)


def as_classifier(value: Any) -> Classifier:
    """A classifier as it is; a plain function as one.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Classifier) else FunctionClassifier(plain_function(value, "the classifier"))


# Functions are converted on the way in, which mypy cannot see.
if TYPE_CHECKING:
    AnyClassifier: TypeAlias = Any
else:
    AnyClassifier = Classifier


def entropy(log_p: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
    """-sum_c p_c log p_c in nats, of log-probabilities; a class of probability zero adds nothing."""
    return cross_entropy(log_p, log_p)


def cross_entropy(
    log_p: Float[Array, "*batch classes"], log_q: Float[Array, "*batch classes"]
) -> Float[Array, "*batch"]:
    """-sum_c p_c log q_c in nats, of log-probabilities. Finite: log 0 counts as the logarithm of the least float."""
    least = jnp.log(jnp.finfo(log_p.dtype).tiny)
    return -jnp.sum(jnp.exp(log_p) * jnp.maximum(log_q, least), axis=-1)


class ClassAcquisition(Acquisition):
    """An acquisition that compares what a classifier says of D and of D u scan.

    - `classifier`: a `Classifier`, or a function from a cloud to log-probabilities.
    - `num_points`: D is thinned to so many by farthest point sampling, once a step, before scans are added to it.
    """

    cloud_only: ClassVar[bool] = True
    classifier: AnyClassifier = eqx.field(converter=as_classifier)
    num_points: int = eqx.field(static=True, default=1024)

    def context(self, step: StepInputs) -> Context:
        """D, thinned, and log p^(t)."""
        thinned = limit_capacity(step.observations.cloud, self.num_points)
        return thinned, self._log_p(thinned)

    def _log_p(self, cloud: PointCloud) -> Any:
        return returned(self.classifier(cloud), "the classifier's answer", 1, _LOG_P)

    @abstractmethod
    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, "*values"]:
        """The value, in nats, of a scan that takes the classifier's answer from log p^(t) to log p^(t+1)."""

    def score(self, context: Context, view: ImaginedView) -> Float[Array, "*values"]:
        """`compare`; zero for a scan that sees nothing."""
        cloud, log_p = context
        return zero_if_empty(view.scan, self.compare(log_p, self._log_p(concatenate(cloud, view.scan))))

    @property
    def batch_size(self) -> int:
        """As the classifier prefers."""
        return self.classifier.batch_size

    def answer(self, cloud: PointCloud) -> "ClassAnswer":
        """The probabilities of the classes given D."""
        p = np.asarray(self.answer_values(cloud), np.float64)
        names = self.classifier.classes or tuple(f"class {index}" for index in range(len(p)))
        return ClassAnswer(tuple(names), p)

    def answer_values(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """The probabilities of the classes given D."""
        return jnp.exp(context_of(self, cloud)[1])

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "ClassAnswer | None":
        """The object's own class, where it says one that the classifier knows."""
        label = scene.class_label
        if label is None:
            return None
        names = self.answer(cloud).names
        return ClassAnswer(names, np.eye(len(names))[int(label)]) if 0 <= int(label) < len(names) else None

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` if the classifier's answer on D is not a vector of log-probabilities, one for each
        of the classes that it names."""
        log_p = context_of(self, cloud)[1]
        require(len(log_p) >= 2, f"the classifier's answer has shape {jnp.shape(log_p)}: {_LOG_P}")
        total = float(jnp.sum(jnp.exp(log_p)))
        require(
            abs(total - 1.0) < 1e-3,
            f"the classifier's answers are not log-probabilities: their exponentials sum to {total:.4g}; give "
            "log_softmax of its logits, or the logarithms of probabilities",
        )
        names = self.classifier.classes
        require(
            names is None or len(names) == len(log_p),
            f"the classifier names {len(names or ())} classes but gives {len(log_p)} probabilities: give as many names",
        )


class CrossEntropy(ClassAcquisition):
    """The paper's alpha^(CE): -sum_c p_c^(t) log p_c^(t+1), of the classes' probabilities given D and given D u scan.

    - `classifier`: a function from a cloud to log-probabilities.
    - `num_points`: D is thinned to so many by farthest point sampling, once a step.
    """

    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, ""]:
        """In nats; zero is the least there is."""
        return cross_entropy(log_p, log_q)

    @property
    def quantity(self) -> Quantity:
        meaning = "cross-entropy of the classes before and after an imagined scan, mean over posterior samples."
        return Quantity("expected cross-entropy", "nats", meaning)


class EntropyReduction(ClassAcquisition):
    """max(0, H(p^(t)) - H(p^(t+1))): the expected improvement of the paper's u_E(D) = sum_c p_c log p_c.

    - `classifier`, `num_points`: as of `CrossEntropy`.
    """

    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, ""]:
        """In nats."""
        return jnp.maximum(0.0, entropy(log_p) - entropy(log_q))

    @property
    def quantity(self) -> Quantity:
        meaning = "how much an imagined scan lowers the entropy of the classes, mean over posterior samples."
        return Quantity("expected reduction of entropy", "nats", meaning)


class MixedEntropy(ClassAcquisition):
    """Cross-entropy while the class is open, entropy reduction once it is nearly settled (the authors' code).

    `CrossEntropy` where the entropy of p^(t) is above `threshold` (nats), else `EntropyReduction`.

    - `classifier`, `num_points`: as of `CrossEntropy`.
    """

    threshold: float = eqx.field(static=True, default=0.75)

    def __check_init__(self):
        check_fields(self)
        require(self.threshold >= 0, f"the entropy's threshold is {self.threshold}; it must not be negative")

    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, ""]:
        """In nats."""
        before = entropy(log_p)
        reduction = jnp.maximum(0.0, before - entropy(log_q))
        return jnp.where(before > self.threshold, cross_entropy(log_p, log_q), reduction)

    @property
    def quantity(self) -> Quantity:
        meaning = "expected cross-entropy, or expected reduction of entropy once the class is nearly settled."
        return Quantity("expected cross-entropy or reduction of entropy", "nats", meaning)


class ClassAnswer(Answer):
    """The probabilities of the classes."""

    form: str = "{:.2f}"
