"""The networks that ship with jaxnbv; `scripts/train_pyramid.py` and `scripts/train_parts.py` make their weights."""

from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from jaxnbv.checks import InputError, require
from jaxnbv.networks.classifier import CloudClassifier
from jaxnbv.networks.compact_segmenter import CompactPartSegmenter
from jaxnbv.networks.invariant import InvariantClassifier
from jaxnbv.networks.segmenter import CloudSegmenter

Network = TypeVar("Network", bound=eqx.Module)

# Longest side of the box of a training object, in the network's units.
TRAINED_SIDE = 2.5


def pyramid_classifier(longest_side: float = TRAINED_SIDE, num_points: int = 1024) -> CloudClassifier:
    """The shipped classifier of synthetic pyramids whose box has this longest side, in scene units.

    It was trained on 1,024 points a cloud; fed 512 it is a little less often right, and twice as fast.

    **Raises:** `ValueError` if `longest_side` or `num_points` is not positive.
    """
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    with resources.as_file(resources.files("jaxnbv.networks") / "weights" / "pyramid.safetensors") as path:
        network, classes = load_invariant(path)
    return CloudClassifier(network, num_points, scale=TRAINED_SIDE / longest_side, classes=classes)


def save_invariant(network: InvariantClassifier, classes: tuple[str, ...], path: str | Path) -> None:
    """Write the network's arrays and the names of its classes as a safetensors file."""
    _save(network, path, {"classes": ",".join(classes)})


def load_invariant(path: str | Path) -> tuple[InvariantClassifier, tuple[str, ...]]:
    """The network that `save_invariant` wrote, and the names of its classes.

    **Raises:** `ValueError` for a file that is missing, damaged, of another network or not finite.
    """
    tensors, metadata = _read(path)
    require("classes" in metadata, f"{path} is damaged or holds another network: it does not name its classes")
    classes = tuple(metadata["classes"].split(","))
    blank = eqx.filter_eval_shape(InvariantClassifier, len(classes), jax.random.key(0))
    return _filled(blank, tensors, path), classes


def part_segmenter(category: str | int, num_points: int = 2048, longest_side: float = TRAINED_SIDE) -> CloudSegmenter:
    """The shipped segmenter of the procedural objects of `jaxnbv.datasets.part_scene`, for one of their categories.

    It was trained on objects whose box has the longest side 2.5, upright and facing one way, seen by parts.

    **Raises:** `ValueError` for an unknown category, or if `num_points` or `longest_side` is not positive.
    """
    require(longest_side > 0, f"the longest side is {longest_side}; it must be positive")
    with resources.as_file(resources.files("jaxnbv.networks") / "weights" / "parts.safetensors") as path:
        network = load_compact_segmenter(path)
    return CloudSegmenter(network, category, num_points, scale=2.0 / longest_side)


def save_compact_segmenter(network: CompactPartSegmenter, path: str | Path) -> None:
    """Write the network's arrays as a safetensors file."""
    _save(network, path, {})


def load_compact_segmenter(path: str | Path) -> CompactPartSegmenter:
    """The network that `save_compact_segmenter` wrote.

    **Raises:** `ValueError` for a file that is missing, damaged, of another network or not finite.
    """
    blank = eqx.filter_eval_shape(CompactPartSegmenter, jax.random.key(0))
    return _filled(blank, _read(path)[0], path)


def _save(network: eqx.Module, path: str | Path, metadata: dict[str, str]) -> None:
    tensors = {name: np.asarray(leaf) for name, leaf in _named(network)}
    Path(path).write_bytes(safetensors.numpy.save(tensors, metadata))


def _read(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    require(Path(path).is_file(), f"there is no file {path}: give the path of a safetensors file")
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError, KeyError) as error:
        raise InputError(f"{path} is damaged or holds another network ({error}): write it again") from error


def _filled(blank: Network, tensors: dict[str, np.ndarray], path: str | Path) -> Network:
    """The network of the shapes of `blank`, with the arrays of a file."""
    names = [name for name, _ in _named(blank)]
    expected = {name: leaf.shape for name, leaf in _named(blank)}
    found = {name: array.shape for name, array in tensors.items()}
    require(expected == found, f"{path} holds another network: its arrays are {found}, expected {expected}")
    finite = all(np.isfinite(array).all() for array in tensors.values())
    require(finite, f"{path} has entries that are not finite: write it again")
    leaves = [jnp.asarray(tensors[name], jnp.result_type(float)) for name in names]
    return jax.tree.unflatten(jax.tree.structure(blank), leaves)


def _named(network) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(network)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]
