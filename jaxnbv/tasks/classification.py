"""Classification: which class is the object of?

A classifier is any function from a `PointCloud` (rows, masked) to log-probabilities, log p = classifier(cloud): a
network of `jaxnbv.networks`, one of your own, or a `HostClassifier`. In an attribute `classes` it may say their names.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, Answer, Quantity, context_of, preferred_batch_size, zero_if_empty
from jaxnbv.checks import InputError, check_fields, require
from jaxnbv.geometry.cloud import PointCloud, concatenate, limit_capacity
from jaxnbv.scanning import Surface
from jaxnbv.tasks.stopping import StopContext, StopRule

Classifier: TypeAlias = Callable[[PointCloud], Float[Array, " classes"]]
# Their shape is checked by `Acquisition.check`.
Context: TypeAlias = tuple[PointCloud, Array]


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

    - `classifier`: a function from a cloud to log-probabilities.
    - `num_points`: D is thinned to so many by farthest point sampling, once a step, before scans are added to it.
    """

    classifier: Classifier
    num_points: int = eqx.field(static=True, default=1024)

    def context(self, cloud: PointCloud) -> Context:
        """D, thinned, and log p^(t)."""
        thinned = limit_capacity(cloud, self.num_points)
        return thinned, self.classifier(thinned)

    @abstractmethod
    def compare(self, log_p: Float[Array, " classes"], log_q: Float[Array, " classes"]) -> Float[Array, "*values"]:
        """The value, in nats, of a scan that takes the classifier's answer from log p^(t) to log p^(t+1)."""

    def __call__(self, context: Context, scan: PointCloud) -> Float[Array, "*values"]:
        """`compare`; zero for a scan that sees nothing."""
        cloud, log_p = context
        return zero_if_empty(scan, self.compare(log_p, self.classifier(concatenate(cloud, scan))))

    @property
    def batch_size(self) -> int:
        """As the classifier prefers."""
        return preferred_batch_size(self.classifier)

    def answer(self, cloud: PointCloud) -> "ClassAnswer":
        """The probabilities of the classes given D."""
        p = np.exp(np.asarray(context_of(self, cloud)[1], np.float64))
        names = getattr(self.classifier, "classes", None) or tuple(f"class {index}" for index in range(len(p)))
        return ClassAnswer(tuple(names), p)

    def true_answer(self, scene: Surface, cloud: PointCloud) -> "ClassAnswer | None":
        """The object's own class, where it says one that the classifier knows."""
        label = getattr(getattr(scene, "sdf", None), "label", None)
        if not isinstance(label, Array) or label.ndim > 0:
            return None
        names = self.answer(cloud).names
        return ClassAnswer(names, np.eye(len(names))[int(label)]) if 0 <= int(label) < len(names) else None

    def check(self, cloud: PointCloud) -> None:
        """**Raises:** `ValueError` if the classifier's answer on D is not a vector of log-probabilities, one for each
        of the classes that it names."""
        log_p = context_of(self, cloud)[1]
        require(
            jnp.ndim(log_p) == 1 and jnp.size(log_p) >= 2,
            f"the classifier's answer has shape {jnp.shape(log_p)}: give log-probabilities, one for each of two "
            "classes or more",
        )
        total = float(jnp.sum(jnp.exp(log_p)))
        require(
            abs(total - 1.0) < 1e-3,
            f"the classifier's answers are not log-probabilities: their exponentials sum to {total:.4g}; give "
            "log_softmax of its logits, or the logarithms of probabilities",
        )
        names = getattr(self.classifier, "classes", None)
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


class Sure(StopRule):
    """Stop once the class is known: it has this probability given D, and given each of several random halves of D too,
    since a single answer may be sure by chance.

    - `probability`: within (0, 1).
    - `num_resamplings`: how many halves are drawn.

    **Raises:** `ValueError` for another probability or a negative number; of an acquisition without a classifier.
    """

    probability: float = eqx.field(static=True, default=0.95)
    num_resamplings: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        check_fields(self)
        require(0 < self.probability < 1, f"the probability is {self.probability}; it must lie within (0, 1)")
        require(
            self.num_resamplings >= 0, f"the number of resamplings is {self.num_resamplings}; it must not be negative"
        )

    def check(self, acquisition: Acquisition) -> None:
        _of_classes(acquisition)

    def after(self, context: StopContext) -> str | None:
        return self.reason(context.acquisition, context.observations.cloud, context.key)

    def reason(self, acquisition: Acquisition, cloud: PointCloud, key: PRNGKeyArray) -> str | None:
        """Why the class is known given D, in words; None if it is not. `key`: of the random halves."""
        acquisition = _of_classes(acquisition)
        answer = acquisition.answer(cloud)
        best = int(np.argmax(answer.values))
        least = float(answer.values[best])
        for index in range(self.num_resamplings):
            if least < self.probability:
                return None
            half = acquisition.answer(half_of(cloud, jax.random.fold_in(key, index)))
            least = min(least, float(half.values[best]))
        if least < self.probability:
            return None
        halves = f", and at least {100 * least:.0f} % given half of the points" if self.num_resamplings else ""
        return f"sure of {answer.names[best]} ({100 * float(answer.values[best]):.0f} %{halves})"


def _of_classes(acquisition: Acquisition) -> ClassAcquisition:
    if not isinstance(acquisition, ClassAcquisition):
        raise InputError(
            f"Sure is about a class, but {type(acquisition).__name__} has no classifier: use CrossEntropy or "
            "MixedEntropy, or another rule"
        )
    return acquisition


@jax.jit
def half_of(cloud: PointCloud, key: PRNGKeyArray) -> PointCloud:
    """Each of a cloud's points with probability one half."""
    kept = cloud.mask & jax.random.bernoulli(key, 0.5, cloud.mask.shape)
    points, normals = (jnp.where(kept[:, None], rows, 0.0) for rows in (cloud.points, cloud.normals))
    return PointCloud(points, normals, kept)
