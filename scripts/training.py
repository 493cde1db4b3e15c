"""Training of networks on labelled examples, and calibration of classifiers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp
from tqdm import tqdm

from jaxnbv import PointCloud
from jaxnbv.checks import AnyArray
from jaxnbv.storage.files import write_whole

Network = TypeVar("Network", bound=eqx.Module)

# Examples whose derivatives are computed together. More would not fit into a processor's cache.
_TOGETHER = 2


def train(
    network: Network, clouds: PointCloud, labels: Int[AnyArray, " b"], key: PRNGKeyArray, steps: int, **settings: Any
) -> Network:
    """The classifier `network(points, normals, mask)` after `steps` of `fit` to the mean of -log p(label)."""

    def loss(network: Any, example: tuple[PointCloud, Array]) -> Float[Array, ""]:
        cloud, label = example
        return -network(cloud.points, cloud.normals, cloud.mask)[label]

    return fit(network, loss, (clouds, labels), key, steps, **settings)


def fit(
    network: Network,
    loss: Callable[[Any, Any], Float[Array, ""]],
    data: Any,
    key: PRNGKeyArray,
    steps: int,
    batch_size: int = 32,
    learning_rate: float = 2e-3,
    weight_decay: float = 1e-4,
    file: Path | None = None,
) -> Network:
    """The network after `steps` of AdamW on the mean loss, with a one-cycle schedule of the learning rate.

    - `loss`: a function of the network and one example.
    - `data`: the examples, arrays of any structure with a leading axis. Batches are drawn with replacement.
    - `batch_size`: an even number.
    - `file`: the trained network. It is read if it exists, else written.

    A leaf `temperature` of the network is not trained, see `calibrate`.
    """
    if file is not None and file.exists():
        return eqx.tree_deserialise_leaves(file, network)
    examples = jax.tree.map(jnp.asarray, data)
    count = len(jax.tree.leaves(examples)[0])
    optimiser = optax.adamw(optax.cosine_onecycle_schedule(steps, learning_rate), weight_decay=weight_decay)
    trainable = jax.tree.map(eqx.is_inexact_array, network)
    if hasattr(network, "temperature"):
        trainable = eqx.tree_at(lambda net: net.temperature, trainable, False)
    parameters, fixed = eqx.partition(network, trainable)

    @eqx.filter_jit
    def step(parameters, state, examples, index):
        rows = jax.random.randint(jax.random.fold_in(key, index), (batch_size,), 0, count)
        batch = jax.tree.map(lambda leaf: leaf[rows].reshape(-1, _TOGETHER, *leaf.shape[1:]), examples)

        def mean_loss(parameters, some):
            network = eqx.combine(parameters, fixed)
            return jnp.mean(jax.vmap(lambda example: loss(network, example))(some))

        values, slopes = jax.lax.map(lambda some: jax.value_and_grad(mean_loss)(parameters, some), batch)
        updates, state = optimiser.update(jax.tree.map(lambda s: jnp.mean(s, axis=0), slopes), state, parameters)
        return optax.apply_updates(parameters, updates), state, jnp.mean(values)

    state = optimiser.init(parameters)
    with tqdm(range(steps), "training") as bar:
        for index in bar:
            parameters, state, value = step(parameters, state, examples, jnp.asarray(index))
            if index % 50 == 0:
                bar.set_postfix_str(f"loss {float(value):.3f}")
    trained = eqx.combine(parameters, fixed)
    if file is not None:
        write_whole(file, lambda out: eqx.tree_serialise_leaves(out, trained))
    return trained


@eqx.filter_jit
def log_probabilities(network: Any, clouds: PointCloud) -> Float[Array, "b classes"]:
    """The network's log-probabilities for a batch of clouds, computed one after the other."""
    return jax.lax.map(lambda cloud: network(cloud.points, cloud.normals, cloud.mask), clouds)


def calibrate(network: Network, clouds: PointCloud, labels: Int[AnyArray, " b"]) -> Network:
    """The network with the temperature that makes held-out labels most likely (Guo et al. 2017)."""
    log_p = np.asarray(log_probabilities(network, clouds), np.float64)
    rows, labels = np.arange(len(labels)), np.asarray(labels)

    def loss(log_factor):
        scaled = log_p * np.exp(-log_factor)
        return np.mean(logsumexp(scaled, axis=1) - scaled[rows, labels])

    best = minimize_scalar(loss, bounds=(-3.0, 3.0), method="bounded")
    old: Any = network
    return eqx.tree_at(lambda net: net.temperature, network, old.temperature * np.exp(best.x))


def expected_calibration_error(
    log_p: Float[AnyArray, "b classes"], labels: Int[AnyArray, " b"], bins: int = 15
) -> float:
    """Mean distance between confidence and accuracy over bins of equal width in confidence, weighted by their rows."""
    p = np.exp(np.asarray(log_p, np.float64))
    confidence, right = p.max(axis=1), p.argmax(axis=1) == np.asarray(labels)
    index = np.minimum((confidence * bins).astype(int), bins - 1)
    gaps = np.bincount(index, weights=confidence - right, minlength=bins)
    return float(np.abs(gaps).sum() / len(p))
