"""Loads and saves networks: published PointNet++ checkpoints, and files of jaxnbv's own networks.

`save_checkpoint` stores a network's arrays, keyed by attribute path, such as `pattern.pair.weight`. The metadata of the
file hold the network's class and the arguments of its constructor.
"""

import functools
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from jaxnbv.checks import InputError, checked, require
from jaxnbv.networks.invariant import InvariantClassifier
from jaxnbv.networks.pointnet2 import CompactPartSegmenter, PointNet2Classifier, PointNet2PartSegmenter
from jaxnbv.networks.published import published_network
from jaxnbv.networks.torch_format import read_torch_tensors
from jaxnbv.storage.files import write_whole

OwnNetwork = InvariantClassifier | CompactPartSegmenter
Network = PointNet2Classifier | PointNet2PartSegmenter | OwnNetwork
_Tensors = Mapping[str, np.ndarray]
_KINDS: dict[str, type] = {kind.__name__: kind for kind in (InvariantClassifier, CompactPartSegmenter)}


def load_checkpoint(path: str | Path) -> Network:
    """Load the network in a PyTorch (.pth, .pt) or .safetensors file.

    The network is a classifier or a part segmenter: PointNet++ as published, or a network that `save_checkpoint` wrote.
    No code in the file is run, and PyTorch is not needed. To apply the network to a `PointCloud`, wrap it in
    `CloudClassifier` or `CloudSegmenter`.

    **Raises:** `ValueError` if the file has a different suffix, is missing or damaged, or if its tensors do not fit any
    of these networks.
    """
    tensors, metadata = _read(path)
    try:
        if "network" in metadata:
            return _fill(_blank_network(metadata["network"]), tensors)
        return published_network(tensors)
    except InputError as error:
        raise InputError(f"{path} does not hold a supported network: {error}") from error


@checked
def save_checkpoint(network: OwnNetwork, path: str | Path) -> None:
    """Write an `InvariantClassifier` or a `CompactPartSegmenter` to a safetensors file.

    **Raises:** `ValueError` if the network has another type, or if the file cannot be written.
    """
    settings = network.settings if isinstance(network, InvariantClassifier) else {}
    metadata = {"network": json.dumps({"kind": type(network).__name__, **settings})}
    arrays = {name: np.array(leaf, order="C") for name, leaf in _named_leaves(network)}
    write_whole(Path(path), lambda file: file.write(safetensors.numpy.save(arrays, metadata)))


def _read(path: str | Path) -> tuple[_Tensors, Mapping[str, str]]:
    """Return the tensors in a file, keyed by name, and the file's metadata."""
    suffix = Path(path).suffix
    require(
        suffix in (".pth", ".pt", ".safetensors"),
        f"cannot tell what {path} is: a checkpoint ends in .pth or .pt (PyTorch) or .safetensors",
    )
    if suffix != ".safetensors":
        return read_torch_tensors(path), {}
    require(os.path.isfile(path), f"there is no file {path}: give the path of a safetensors file")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is damaged or no safetensors file ({error}): fetch or write it again") from error


def _blank_network(text: str) -> Any:
    """Make the network that the text in a file's metadata describes, with shapes in place of arrays."""
    try:
        arguments = json.loads(text)
        kind = _KINDS[arguments.pop("kind")]
        settings = {name: tuple(value) if isinstance(value, list) else value for name, value in arguments.items()}
        return eqx.filter_eval_shape(functools.partial(kind, key=jax.random.key(0), **settings))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"its metadata are {text[:200]!r}, which makes no network ({error})") from error


def _fill(blank: Any, arrays: _Tensors) -> Any:
    """Return a copy of the network `blank` in which arrays, keyed by attribute path, replace the shapes."""
    expected = {name: leaf.shape for name, leaf in _named_leaves(blank)}
    leaves: dict[str, np.ndarray] = {}
    for name in sorted(expected.keys() | arrays.keys()):
        require(name in arrays, f"the array {name} is missing")
        require(name in expected, f"the array {name} is not part of such a network")
        shape = arrays[name].shape
        require(shape == expected[name], f"the array {name} has shape {shape}; expected {expected[name]}")
        # 64-bit numbers may overflow in JAX's default type.
        with np.errstate(over="ignore"):
            leaves[name] = arrays[name].astype(jnp.result_type(float))
        require(bool(np.isfinite(leaves[name]).all()), f"the array {name} has entries that are not finite")
    temperature = leaves.get("temperature")
    require(temperature is None or bool(temperature > 0), f"the temperature is {temperature}; it must be positive")
    return jax.tree.unflatten(jax.tree.structure(blank), [jnp.asarray(leaves[name]) for name in expected])


def _named_leaves(network: Any) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(network)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]
