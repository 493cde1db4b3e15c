"""Classification: which class is the object of?

A classifier is any function from a `PointCloud` (rows, masked) to log-probabilities, log p = classifier(cloud): a
network of `jaxnbv.networks`, one of your own, or a `HostClassifier`. In an attribute `classes` it may say their names.
"""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.acquisition import Score, context_of, preferred_batch_size, zero_if_empty
from jaxnbv.answers import Answer, Panel, Quantity
from jaxnbv.checks import check_fields, require
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.scanning import Surface

Classifier: TypeAlias = Callable[[PointCloud], Float[Array, " classes"]]
# Their shape is checked by `Score.check`.
Context: TypeAlias = tuple[PointCloud, Array]
# By when a reader may rely on a class.
_SURE = 0.95


def entropy(log_p: Float[Array, "*batch classes"]) -> Float[Array, "*batch"]:
    """-sum_c p_c log p_c in nats, of log-probabilities; a class of probability zero adds nothing."""
    return cross_entropy(log_p, log_p)


def cross_entropy(
    log_p: Float[Array, "*batch classes"], log_q: Float[Array, "*batch classes"]
) -> Float[Array, "*batch"]:
    """-sum_c p_c log q_c in nats, of log-probabilities. Finite: log 0 counts as the logarithm of the least float."""
    least = jnp.log(jnp.finfo(log_p.dtype).tiny)
    return -jnp.sum(jnp.exp(log_p) * jnp.maximum(log_q, least), axis=-1)


class NegativeEntropy(eqx.Module):
    """The paper's u_E(D) = sum_c p_c log p_c, a utility for `ExpectedUtilityImprovement`."""

    classifier: Classifier

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """u_E in nats: 0 where the class is certain, -log(classes) where nothing is known."""
        return -entropy(self.classifier(cloud))

    @property
    def batch_size(self) -> int:
        """As the classifier prefers."""
        return preferred_batch_size(self.classifier)

    @property
    def improvement(self) -> Quantity:
        """What its expected improvement is."""
        meaning = "how much an imagined scan lowers the entropy of the classes, mean over posterior samples."
        return Quantity("expected reduction of entropy", "nats", meaning)

    def answer(self, cloud: PointCloud) -> "ClassAnswer":
        """The probabilities of the classes."""
        return _answer(self.classifier, _log_p(self.classifier, cloud))

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "ClassAnswer | None":
        """The object's own class, where it says one."""
        return _true_class(scene, cloud, self.answer)

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` if the classifier's answer on D is not a vector of log-probabilities."""
        check_log_p(_log_p(self.classifier, cloud))


class ClassScore(Score):
    """A score that compares what a classifier says of D and of D u scan.

    - `classifier`: a function from a cloud to log-probabilities.
    - `num_points`: D is thinned to so many by farthest point sampling, once a step, before scans are added to it.
    """

    classifier: eqx.AbstractVar[Classifier]
    num_points: eqx.AbstractVar[int]

    def context(self, cloud: PointCloud) -> Context:
        """D, thinned, and log p^(t)."""
        thinned = limit_capacity(cloud, self.num_points)
        return thinned, self.classifier(thinned)

    @property
    def batch_size(self) -> int:
        """As the classifier prefers."""
        return preferred_batch_size(self.classifier)

    def answer(self, cloud: PointCloud) -> "ClassAnswer":
        """The probabilities of the classes given D."""
        return _answer(self.classifier, context_of(self, cloud)[1])

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "ClassAnswer | None":
        """The object's own class, where it says one."""
        return _true_class(scene, cloud, self.answer)

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` if the classifier's answer on D is not a vector of log-probabilities, one for each
        of the classes that it names."""
        log_p = context_of(self, cloud)[1]
        check_log_p(log_p)
        names = getattr(self.classifier, "classes", None)
        require(
            names is None or len(names) == len(log_p),
            f"the classifier names {len(names or ())} classes but tells {len(log_p)} apart: give as many names",
        )


class CrossEntropy(ClassScore):
    """The paper's alpha^(CE): -sum_c p_c^(t) log p_c^(t+1), of the classes' probabilities given D and given D u scan.

    - `classifier`, `num_points`: see `ClassScore`.
    """

    classifier: Classifier
    num_points: int = eqx.field(static=True, default=1024)

    def __call__(self, context: Context, scan: PointCloud) -> Float[Array, ""]:
        """In nats; the least there is, zero, for a scan that sees nothing."""
        cloud, log_p = context
        return zero_if_empty(scan, cross_entropy(log_p, self.classifier(concatenate(cloud, scan))))

    @property
    def quantity(self) -> Quantity:
        meaning = "cross-entropy of the classes before and after an imagined scan, mean over posterior samples."
        return Quantity("expected cross-entropy", "nats", meaning)


class MixedEntropy(ClassScore):
    """Cross-entropy while the class is open, entropy reduction once it is nearly settled (the authors' code).

    `CrossEntropy` where the entropy of p^(t) is above `threshold` (nats), else max(0, H(p^(t)) - H(p^(t+1))).

    - `classifier`, `num_points`: see `ClassScore`.
    """

    classifier: Classifier
    threshold: float = eqx.field(static=True, default=0.75)
    num_points: int = eqx.field(static=True, default=1024)

    def __check_init__(self):
        check_fields(self)
        require(self.threshold >= 0, f"the entropy's threshold is {self.threshold}; it must not be negative")

    def __call__(self, context: Context, scan: PointCloud) -> Float[Array, ""]:
        """In nats; zero for a scan that sees nothing."""
        cloud, log_p = context
        log_q = self.classifier(concatenate(cloud, scan))
        before = entropy(log_p)
        reduction = jnp.maximum(0.0, before - entropy(log_q))
        return zero_if_empty(scan, jnp.where(before > self.threshold, cross_entropy(log_p, log_q), reduction))

    @property
    def quantity(self) -> Quantity:
        meaning = "expected cross-entropy, or expected reduction of entropy once the class is nearly settled."
        return Quantity("expected cross-entropy or reduction of entropy", "nats", meaning)


class ClassAnswer(Answer):
    """The probabilities of the classes; the likeliest five are told."""

    form: str = "{:.2f}"

    @property
    def shown(self) -> tuple[int, ...]:
        return tuple(sorted(np.argsort(-self.values)[:5].tolist()))

    def sentence(self, before: Answer | None = None) -> str:
        best = int(np.argmax(self.values))
        text = f"The classifier says {self.names[best]} with probability {self.values[best]:.2f}"
        if before is not None:
            previous = int(np.argmax(before.values))
            behind = "" if best == previous else f", behind {self.names[previous]} with {before.values[previous]:.2f}"
            text += f" (was {before.values[best]:.2f}{behind})"
        return f"{text}."

    @property
    def question(self) -> str:
        return "Which class is it?"

    @property
    def found(self) -> str:
        best = int(np.argmax(self.values))
        p = self.values[best]
        return self.names[best] if p == 1.0 else f"{self.names[best]}, probability {p:.2f}"

    @property
    def settled_means(self) -> str:
        return f"probability {_SURE} or more"

    def settled(self, before: Answer | None) -> bool:
        """Sure, and not of another class than the view before was sure of."""
        contradicted = (
            before is not None
            and before.values.max() >= _SURE
            and int(np.argmax(before.values)) != int(np.argmax(self.values))
        )
        return bool(self.values.max() >= _SURE) and not contradicted

    def panels(self, truth: Answer | None) -> tuple[Panel, ...]:
        """The probabilities of all classes; of the truth, 1 and 0."""
        true = None if truth is None else truth.values
        return (Panel("probability", self.names, self.values, true, bars=True, goal=_SURE),)


def _true_class(scene: Surface, cloud: PointCloud, answer: Callable[[PointCloud], ClassAnswer]) -> ClassAnswer | None:
    """The answer that a scene's own class would be, in the names of that on a cloud."""
    label = getattr(getattr(scene, "sdf", None), "label", None)
    if not isinstance(label, Array) or label.ndim > 0:
        return None
    names = answer(cloud).names
    return ClassAnswer(names, np.eye(len(names))[int(label)]) if 0 <= int(label) < len(names) else None


def _answer(classifier: Classifier, log_p: Float[Array, " classes"]) -> ClassAnswer:
    p = np.exp(np.asarray(log_p, np.float64))
    names = getattr(classifier, "classes", None) or tuple(f"class {index}" for index in range(len(p)))
    return ClassAnswer(tuple(names), p)


def check_log_p(log_p: Array) -> None:
    """Raise `ValueError` unless these are log-probabilities of classes."""
    require(
        jnp.ndim(log_p) == 1 and jnp.size(log_p) >= 2,
        f"the classifier's answer has shape {jnp.shape(log_p)}: give log-probabilities, one for each of two classes or "
        "more",
    )
    total = float(jnp.sum(jnp.exp(log_p)))
    require(
        abs(total - 1.0) < 1e-3,
        f"the classifier's answers are not log-probabilities: their exponentials sum to {total:.4g}; apply log_softmax "
        "to its logits",
    )


def predict(score: Score, cloud: PointCloud) -> Float[Array, " classes"] | None:
    """log p of the classes given D, as the score sees them; None for a score that does not classify."""
    if isinstance(score, ClassScore):
        return context_of(score, cloud)[1]
    classifier = getattr(getattr(score, "utility", None), "classifier", None)
    return None if classifier is None else _log_p(classifier, context_of(score, cloud)[0])


@eqx.filter_jit
def _log_p(classifier: Classifier, cloud: PointCloud) -> Array:
    return classifier(cloud)
