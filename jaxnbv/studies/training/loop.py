"""Training of networks on labelled clouds, and calibration of classifiers."""

import hashlib
import json
import zipfile
import zlib
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

from jaxnbv.checks import AnyArray, InputError, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.progress import progress_bar
from jaxnbv.storage.files import make_folder, write_whole

Network = TypeVar("Network", bound=eqx.Module)

# Clouds whose derivatives are computed together: more would leave a processor's cache.
_TOGETHER = 2
_STEPS_A_CHECKPOINT = 500


def train(
    network: Network,
    clouds: PointCloud,
    labels: Int[AnyArray, " b"],
    key: PRNGKeyArray,
    steps: int,
    batch_size: int = 32,
    learning_rate: float = 2e-3,
    weight_decay: float = 1e-4,
    folder: str | Path | None = None,
    progress: bool = True,
) -> Network:
    """The classifier after `steps` of `fit` to the mean of -log p(label).

    It is called as `network(points, normals, mask)` and gives log-probabilities. Settings as of `fit`.

    **Raises:** `ValueError` if there are no clouds, or numbers of clouds and labels differ, and as `fit` does.
    """
    count = clouds.mask.shape[0]
    require(count > 0 and count == len(labels), f"{count} clouds and {len(labels)} labels: give one label a cloud")

    def loss(network: Any, example: tuple[PointCloud, Array]) -> Float[Array, ""]:
        cloud, label = example
        return -network(cloud.points, cloud.normals, cloud.mask)[label]

    data = clouds, np.asarray(labels)
    return fit(network, loss, data, key, steps, batch_size, learning_rate, weight_decay, folder, progress)


def fit(
    network: Network,
    loss: Callable[[Any, Any], Float[Array, ""]],
    data: Any,
    key: PRNGKeyArray,
    steps: int,
    batch_size: int = 32,
    learning_rate: float = 2e-3,
    weight_decay: float = 1e-4,
    folder: str | Path | None = None,
    progress: bool = True,
) -> Network:
    """The network after `steps` of AdamW on the mean loss, with a one-cycle schedule of the learning rate.

    - `loss`: a function of the network and one example.
    - `data`: the examples, arrays of any structure with a leading axis.

    A leaf `temperature` of the network is left to `calibrate`. Batches are drawn with replacement by the key and the
    step's number, so that with `folder`, where a checkpoint is written every 500 steps, a run that was interrupted
    continues as if it had not been.

    **Raises:** `ValueError` if there are no examples or arrays of different lengths, a number is not positive, the
    batch size is odd, or the folder holds the checkpoint of another training.
    """
    counts = {len(leaf) for leaf in jax.tree.leaves(data)}
    require(len(counts) == 1 and counts != {0}, f"the examples' arrays have lengths {sorted(counts)}: give one a row")
    (count,) = counts
    require(
        steps >= 1 and learning_rate > 0 and batch_size >= 1 and batch_size % _TOGETHER == 0,
        f"steps={steps}, batch_size={batch_size}, learning_rate={learning_rate}: all must be positive, "
        f"and the batch size a multiple of {_TOGETHER}",
    )
    optimiser = optax.adamw(optax.cosine_onecycle_schedule(steps, learning_rate), weight_decay=weight_decay)
    trainable = _trainable(network)
    parameters, fixed = eqx.partition(network, trainable)
    start, carry = 0, (parameters, optimiser.init(parameters))
    checkpoint = None
    if folder is not None:
        identity = hashlib.sha256()
        for array in (jax.random.key_data(key), *jax.tree.leaves(data), *jax.tree.leaves(parameters)):
            identity.update(np.ascontiguousarray(array).tobytes())
        settings = {"steps": steps, "batch_size": batch_size, "learning_rate": learning_rate}
        settings |= {"weight_decay": weight_decay, "examples": count}
        checkpoint = _Checkpoint(Path(folder), {**settings, "identity": identity.hexdigest()})
        start, carry = checkpoint.read(carry)

    examples = jax.tree.map(jnp.asarray, data)

    @eqx.filter_jit
    def step(carry, examples, index):
        parameters, state = carry
        rows = jax.random.randint(jax.random.fold_in(key, index), (batch_size,), 0, count)
        batch = jax.tree.map(lambda leaf: leaf[rows].reshape(-1, _TOGETHER, *leaf.shape[1:]), examples)

        def mean_loss(parameters, some):
            network = eqx.combine(parameters, fixed)
            return jnp.mean(jax.vmap(lambda example: loss(network, example))(some))

        values, slopes = jax.lax.map(lambda some: jax.value_and_grad(mean_loss)(parameters, some), batch)
        updates, state = optimiser.update(jax.tree.map(lambda s: jnp.mean(s, axis=0), slopes), state, parameters)
        return (optax.apply_updates(parameters, updates), state), jnp.mean(values)

    losses: list[Array] = []
    with progress_bar(total=steps, initial=start, desc="training", wanted=progress) as bar:
        for index in range(start, steps):
            carry, value = step(carry, examples, jnp.asarray(index))
            losses.append(value)
            bar.update()
            if len(losses) == 50:
                bar.set_postfix_str(f"loss {np.mean(losses):.3f}")
                losses.clear()
            if checkpoint and ((index + 1) % _STEPS_A_CHECKPOINT == 0 or index + 1 == steps):
                checkpoint.write(index + 1, carry)
    return eqx.combine(carry[0], fixed)


@eqx.filter_jit
def log_probabilities(network: Any, clouds: PointCloud) -> Float[Array, "b classes"]:
    """The network's answers to a batch of clouds, one after the other."""
    return jax.lax.map(lambda cloud: network(cloud.points, cloud.normals, cloud.mask), clouds)


def calibrate(network: Network, clouds: PointCloud, labels: Int[AnyArray, " b"]) -> Network:
    """The network with the temperature that makes held-out labels most likely (Guo et al. 2017).

    **Raises:** `ValueError` if the network has no leaf `temperature`, there are no clouds, or numbers of clouds and
    labels differ.
    """
    require(hasattr(network, "temperature"), f"{type(network).__name__} has no temperature to calibrate")
    count = clouds.mask.shape[0]
    require(count > 0 and count == len(labels), f"{count} clouds and {len(labels)} labels: give one label a cloud")
    log_p = np.asarray(log_probabilities(network, clouds), np.float64)
    labels = np.asarray(labels)

    def loss(log_factor):
        scaled = log_p * np.exp(-log_factor)
        return np.mean(logsumexp(scaled, axis=1) - scaled[np.arange(len(labels)), labels])

    best = minimize_scalar(loss, bounds=(-3.0, 3.0), method="bounded")
    old: Any = network
    return eqx.tree_at(lambda net: net.temperature, network, old.temperature * np.exp(best.x))


def expected_calibration_error(
    log_p: Float[AnyArray, "b classes"], labels: Int[AnyArray, " b"], bins: int = 15
) -> float:
    """Mean distance between confidence and accuracy over bins of equal width in confidence, weighted by their clouds.

    **Raises:** `ValueError` if there are no clouds.
    """
    require(len(labels) > 0, "cannot calibrate on no clouds: give some")
    p = np.exp(np.asarray(log_p, np.float64))
    confidence, right = p.max(axis=1), p.argmax(axis=1) == np.asarray(labels)
    index = np.minimum((confidence * bins).astype(int), bins - 1)
    gaps = np.bincount(index, weights=confidence - right, minlength=bins)
    return float(np.abs(gaps).sum() / len(p))


def _trainable(network: eqx.Module):
    is_trained = jax.tree.map(eqx.is_inexact_array, network)
    if not hasattr(network, "temperature"):
        return is_trained
    return eqx.tree_at(lambda net: net.temperature, is_trained, False)


class _Checkpoint:
    """Where a training run stands, in one file that is replaced as a whole."""

    def __init__(self, folder: Path, settings: dict[str, Any]):
        self.path, self.settings = make_folder(folder) / "training.npz", json.dumps(settings, sort_keys=True)

    def read(self, carry):
        if not self.path.exists():
            return 0, carry
        leaves, structure = jax.tree.flatten(carry)
        try:
            with np.load(self.path, allow_pickle=False) as saved:
                settings, step = str(saved["settings"]), int(saved["step"])
                found = [saved[f"leaf_{index}"] for index in range(len(leaves))]
        except (ValueError, OSError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{self.path} is damaged or of another network ({error}): delete it") from error
        same = settings == self.settings and all(a.shape == b.shape for a, b in zip(found, leaves, strict=True))
        require(same, f"{self.path} belongs to another training ({settings}): choose another folder")
        return step, jax.tree.unflatten(structure, [jnp.asarray(leaf) for leaf in found])

    def write(self, step: int, carry) -> None:
        leaves: dict[str, Any] = {
            f"leaf_{index}": np.asarray(leaf) for index, leaf in enumerate(jax.tree.leaves(carry))
        }
        leaves |= {"settings": self.settings, "step": step}
        write_whole(self.path, lambda file: np.savez(file, **leaves))
