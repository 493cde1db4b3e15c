"""Classification: to which class does the object belong?

A classifier is any function from a `PointCloud` to log-probabilities, log p = classifier(cloud). Rows of the cloud
whose mask is False hold no point. The classifier may be a network of `jaxnbv.networks`, your own network, or a
`HostClassifier`. A `Classifier` may also name its classes.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.acquisition import Acquisition, ImaginedView, context_of, zero_if_empty
from jaxnbv.checks import check_fields, checked_result, require
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import Surface
from jaxnbv.utility import Answer, Quantity, default_batch_size, plain_function

_LOG_P = "give log-probabilities, one for each of two classes or more"
# The thinned cloud and its log-probabilities, whose shape `ClassAcquisition.check` checks.
Context: TypeAlias = tuple[PointCloud, Array]


class Classifier(eqx.Module):
    """Base class of classifiers of clouds. Subclasses must define only `__call__`.

    - `classes`: names of the classes; None for no names.
    """

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """Return the log-probabilities of one cloud. Rows whose mask is False hold no point."""

    @property
    def classes(self) -> tuple[str, ...] | None:
        return None

    @property
    def batch_size(self) -> int:
        """Number of clouds to classify together."""
        return default_batch_size()


class FunctionClassifier(Classifier):
    """A classifier that calls a plain function of a cloud."""

    function: Callable[[PointCloud], Float[Array, " classes"]]

    # `ClassAcquisition` checks the result.
    def __call__(self, cloud: PointCloud) -> Any:
        return self.function(cloud)


def as_classifier(value: Any) -> Classifier:
    """Return a classifier unchanged, or a plain function wrapped as a classifier.

    **Raises:** `ValueError` for anything else.
    """
    return value if isinstance(value, Classifier) else FunctionClassifier(plain_function(value, "the classifier"))


# Fields of this type have a converter for plain functions. mypy does not know about converters.
if TYPE_CHECKING:
    AnyClassifier: TypeAlias = Any
else:
    AnyClassifier = Classifier


def entropy(log_p: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
    """Return the entropy -sum_c p_c log p_c in nats. A class of probability zero contributes zero."""
    return cross_entropy(log_p, log_p)


def cross_entropy(
    log_p: Float[Array, "*batch classes"], log_q: Float[Array, "*batch classes"]
) -> Float[Array, "*batch"]:
    """Return the cross-entropy -sum_c p_c log q_c in nats, from log-probabilities.

    The result is finite, because log q_c is clipped from below at the logarithm of the smallest normal float.
    """
    least = jnp.log(jnp.finfo(log_p.dtype).tiny)
    return -jnp.sum(jnp.exp(log_p) * jnp.maximum(log_q, least), axis=-1)


class ClassAcquisition(Acquisition):
    """Base class of acquisitions that compare a classifier's results before and after a simulated scan.

    - `classifier`, `num_points`: see `CrossEntropy`.
    """

    cloud_only: ClassVar[bool] = True
    classifier: AnyClassifier = eqx.field(converter=as_classifier)
    num_points: int = eqx.field(static=True, default=1024)

    def context(self, step: StepInputs) -> Context:
        """Return the cloud, thinned to `num_points`, and the classifier's log-probabilities for it."""
        thinned = limit_capacity(step.observations.cloud, self.num_points)
        return thinned, self._log_p(thinned)

    def _log_p(self, cloud: PointCloud) -> Any:
        return checked_result(self.classifier(cloud), "the classifier's answer", 1, _LOG_P)

    @abstractmethod
    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, "*values"]:
        """Return the value of a scan in nats.

        - `log_p`, `log_q`: log-probabilities of the classes before and after the scan is added to the cloud.
        """

    def score(self, context: Context, view: ImaginedView) -> Float[Array, "*values"]:
        """Return the result of `compare` for the cloud without and with the scan, or zero for an empty scan."""
        cloud, log_p = context
        return zero_if_empty(view.scan, self.compare(log_p, self._log_p(concatenate(cloud, view.scan))))

    @property
    def batch_size(self) -> int:
        return self.classifier.batch_size

    def answer(self, cloud: PointCloud) -> "ClassAnswer":
        p = np.asarray(self.answer_values(cloud), np.float64)
        names = self.classifier.classes or tuple(f"class {index}" for index in range(len(p)))
        return ClassAnswer(tuple(names), p)

    def answer_values(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """Return the class probabilities, given the cloud."""
        return jnp.exp(context_of(self, cloud)[1])

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "ClassAnswer | None":
        """Return the scene's class as an answer.

        None if the scene has no class, or one that the classifier lacks.
        """
        label = scene.class_label
        if label is None:
            return None
        names = self.answer(cloud).names
        return ClassAnswer(names, np.eye(len(names))[int(label)]) if 0 <= int(label) < len(names) else None

    def check(self, cloud: PointCloud) -> None:
        """Raise `ValueError` unless the classifier returns one log-probability for each class."""
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
    """Cross-entropy -sum_c p_c^(t) log p_c^(t+1) of the class probabilities before and after a scan.

    This is the paper's alpha^(CE). p^(t) are the probabilities given the cloud D, and p^(t+1) the probabilities given D
    and a simulated scan.

    - `classifier`: a `Classifier`, or a function from a cloud to log-probabilities.
    - `num_points`: number of points to which farthest point sampling thins D, once for each proposal.
    """

    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, ""]:
        return cross_entropy(log_p, log_q)

    @property
    def quantity(self) -> Quantity:
        meaning = "cross-entropy of the classes before and after an imagined scan, mean over posterior samples."
        return Quantity("expected cross-entropy", "nats", meaning)


class EntropyReduction(ClassAcquisition):
    """Reduction of the entropy H of the class probabilities by a scan, max(0, H(p^(t)) - H(p^(t+1))).

    This is the improvement of the paper's utility u_E(D) = sum_c p_c log p_c. For p^(t) and p^(t+1) see `CrossEntropy`.

    - `classifier`, `num_points`: see `CrossEntropy`.
    """

    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, ""]:
        return jnp.maximum(0.0, entropy(log_p) - entropy(log_q))

    @property
    def quantity(self) -> Quantity:
        meaning = "how much an imagined scan lowers the entropy of the classes, mean over posterior samples."
        return Quantity("expected reduction of entropy", "nats", meaning)


class MixedEntropy(ClassAcquisition):
    """Cross-entropy while the class is uncertain, then reduction of entropy, as in the authors' code.

    - `classifier`, `num_points`: see `CrossEntropy`.
    - `threshold`: entropy before the scan, in nats, above which the value is that of `CrossEntropy`.
    """

    threshold: float = eqx.field(static=True, default=0.75)

    def __check_init__(self):
        check_fields(self)
        require(self.threshold >= 0, f"the entropy's threshold is {self.threshold}; it must not be negative")

    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, ""]:
        before = entropy(log_p)
        reduction = jnp.maximum(0.0, before - entropy(log_q))
        return jnp.where(before > self.threshold, cross_entropy(log_p, log_q), reduction)

    @property
    def quantity(self) -> Quantity:
        meaning = "expected cross-entropy, or expected reduction of entropy once the class is nearly settled."
        return Quantity("expected cross-entropy or reduction of entropy", "nats", meaning)


class ClassAnswer(Answer):
    """The probability of each class."""

    form: str = "{:.2f}"
