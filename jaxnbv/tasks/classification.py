"""Classification: which class is the object of?

A classifier is any function from a `PointCloud` (rows, masked) to log-probabilities, log p = classifier(cloud): a
network of `jaxnbv.networks`, one of your own, or a `HostClassifier`.
"""

from collections.abc import Callable
from typing import ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.acquisition import ExpectedUtilityImprovement, Score, preferred_batch_size, zero_if_empty
from jaxnbv.checks import InputError, require
from jaxnbv.cloud import PointCloud, concatenate, limit_capacity

Classifier: TypeAlias = Callable[[PointCloud], Float[Array, " classes"]]
Context: TypeAlias = tuple[PointCloud, Float[Array, " classes"]]


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


class CrossEntropy(Score):
    """The paper's alpha^(CE): -sum_c p_c^(t) log p_c^(t+1), of the classes' probabilities given D and given D u scan.

    - `classifier`: a function from a cloud to log-probabilities.
    - `num_points`: D is thinned to so many by farthest point sampling, once a step, before scans are added to it.
    """

    classifier: Classifier
    num_points: int = eqx.field(static=True, default=1024)

    def context(self, cloud: PointCloud) -> Context:
        """D, thinned, and log p^(t)."""
        return _context(self, cloud)

    def __call__(self, context: Context, scan: PointCloud) -> Float[Array, ""]:
        """In nats; the least there is, zero, for a scan that sees nothing."""
        cloud, log_p = context
        return zero_if_empty(scan, cross_entropy(log_p, self.classifier(concatenate(cloud, scan))))

    @property
    def batch_size(self) -> int:
        """As the classifier prefers."""
        return preferred_batch_size(self.classifier)


class MixedEntropy(Score):
    """Cross-entropy while the class is open, entropy reduction once it is nearly settled (the authors' code).

    `CrossEntropy` where the entropy of p^(t) is above `threshold` (nats), else max(0, H(p^(t)) - H(p^(t+1))).

    - `classifier`, `num_points`: as in `CrossEntropy`.
    """

    classifier: Classifier
    threshold: float = eqx.field(static=True, default=0.75)
    num_points: int = eqx.field(static=True, default=1024)

    def __check_init__(self):
        require(self.threshold >= 0, f"the entropy's threshold is {self.threshold}; it must not be negative")

    def context(self, cloud: PointCloud) -> Context:
        """D, thinned, and log p^(t)."""
        return _context(self, cloud)

    def __call__(self, context: Context, scan: PointCloud) -> Float[Array, ""]:
        """In nats; zero for a scan that sees nothing."""
        cloud, log_p = context
        log_q = self.classifier(concatenate(cloud, scan))
        before = entropy(log_p)
        reduction = jnp.maximum(0.0, before - entropy(log_q))
        return zero_if_empty(scan, jnp.where(before > self.threshold, cross_entropy(log_p, log_q), reduction))

    @property
    def batch_size(self) -> int:
        """As the classifier prefers."""
        return preferred_batch_size(self.classifier)


def _context(score: CrossEntropy | MixedEntropy, cloud: PointCloud) -> Context:
    thinned = limit_capacity(cloud, score.num_points)
    return thinned, score.classifier(thinned)


@eqx.filter_jit
def predict(score: Score, cloud: PointCloud) -> Float[Array, " classes"] | None:
    """log p of the classes given D, as the score sees them; None for a score that does not classify."""
    if isinstance(score, CrossEntropy | MixedEntropy):
        return score.context(cloud)[1]
    if isinstance(score, ExpectedUtilityImprovement) and isinstance(score.utility, NegativeEntropy):
        return score.utility.classifier(score.context(cloud)[0])
    return None


def class_names(score: Score) -> tuple[str, ...] | None:
    """What the classes are called, where the score's classifier says so in an attribute `classes`."""
    classifier = getattr(score, "classifier", None) or getattr(getattr(score, "utility", None), "classifier", None)
    return getattr(classifier, "classes", None)


class HostClassifier(eqx.Module):
    """A classifier that runs outside JAX, a PyTorch model say: for search over candidates only.

    - `function`: from points (b, n, 3), unit normals (b, n, 3) and mask (b, n), as NumPy arrays, to log-probabilities
      (b, num_classes). It is called with up to 128 candidates of one posterior sample at once.
    - `num_classes`: how many classes it tells apart.

    **Raises:** `ValueError` when a gradient is asked for. A function that returns another shape, or fails, fails within
    JAX, which raises its own `RuntimeError` with the message in its text.
    """

    function: Callable = eqx.field(static=True)
    num_classes: int = eqx.field(static=True)
    batch_size: ClassVar[int] = 128

    def __check_init__(self):
        require(self.num_classes >= 2, f"num_classes is {self.num_classes}; a classifier tells at least two apart")

    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """Log-probabilities of one cloud; under `vmap`, of all of them in one call."""
        return _call_host(cloud, self)


@eqx.filter_custom_jvp
def _call_host(cloud: PointCloud, host: HostClassifier) -> Float[Array, " classes"]:
    def call(points, normals, mask):
        batch = mask.shape[:-1]
        flat = (np.asarray(a).reshape(-1, *a.shape[len(batch) :]) for a in (points, normals, mask))
        log_p = np.asarray(host.function(*flat), dtype=points.dtype)
        expected = (int(np.prod(batch)), host.num_classes)
        require(
            log_p.shape == expected,
            f"the classifier returned shape {log_p.shape}, not {expected}: log-probabilities, a row a cloud",
        )
        total = np.exp(log_p).sum(axis=-1)
        require(
            bool((np.abs(total - 1.0) < 1e-3).all()),
            f"the classifier's answers are not log-probabilities: their exponentials sum to {total.flat[0]:.4g}; "
            "apply log_softmax to its logits",
        )
        return log_p.reshape(*batch, host.num_classes)

    result = jax.ShapeDtypeStruct((host.num_classes,), cloud.points.dtype)
    return jax.pure_callback(call, result, cloud.points, cloud.normals, cloud.mask, vmap_method="broadcast_all")


@_call_host.def_jvp
def _call_host_jvp(primals, tangents):
    raise InputError("a HostClassifier has no derivative: use DiscreteSearch, or write the classifier in JAX")
