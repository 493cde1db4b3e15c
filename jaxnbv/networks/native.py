"""The arrays of our own networks by name, for safetensors files, and the networks that they make.

Names are attribute paths such as `pattern.pair.weight`; widths are those of the class. Of a classifier the metadata
hold the names of its classes, where it has some, and the radii and the numbers of groups of its levels, separated by
commas.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.networks.compact_segmenter import CompactPartSegmenter
from jaxnbv.networks.invariant import InvariantClassifier

NativeNetwork = InvariantClassifier | CompactPartSegmenter


def arrays_of(network: NativeNetwork) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The network's arrays by name, and the file's metadata."""
    arrays = {name: np.asarray(leaf) for name, leaf in _named(network)}
    if not isinstance(network, InvariantClassifier):
        return arrays, {}
    classes = {} if network.classes is None else {"classes": ",".join(network.classes)}
    levels = network.levels
    radii, groups = (",".join(str(getattr(level, name)) for level in levels) for name in ("radius", "groups"))
    return arrays, classes | {"radii": radii, "groups": groups}


def is_native(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the names are those of one of our own networks."""
    return any(name.startswith(("edge.", "fine.")) for name in arrays)


def build_native(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> NativeNetwork:
    """The network that the arrays make.

    **Raises:** `ValueError` for shapes that are not the network's, another number of names, or entries not finite.
    """
    if any(name.startswith("fine.") for name in arrays):
        return _filled(eqx.filter_eval_shape(CompactPartSegmenter, jax.random.key(0)), arrays)
    last = arrays.get("head.1.bias", np.zeros(0))
    require(last.ndim == 1 and last.size > 0, "the array head.1.bias, of one entry a class, is missing")
    said: dict[str, Any] = {}
    if "classes" in metadata:
        said["classes"] = tuple(metadata["classes"].split(","))
    said |= {name: _numbers(metadata, name, kind) for name, kind in _LEVELS.items() if name in metadata}
    return _filled(eqx.filter_eval_shape(InvariantClassifier, last.size, jax.random.key(0), **said), arrays)


# What the metadata say of levels.
_LEVELS: dict[str, type[int] | type[float]] = {"radii": float, "groups": int}


def _numbers(metadata: Mapping[str, str], name: str, kind: type[int] | type[float]) -> tuple[int | float, ...]:
    try:
        return tuple(map(kind, metadata[name].split(",")))
    except ValueError as error:
        raise InputError(
            f"its metadata say {name}={metadata[name]!r}; expected numbers, separated by commas"
        ) from error


def _filled(blank: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The network of the shapes of `blank`, with these arrays."""
    expected = {name: leaf.shape for name, leaf in _named(blank)}
    found = {name: array.shape for name, array in arrays.items()}
    leaves: dict[str, np.ndarray] = {}
    for name in sorted(expected.keys() | found.keys()):
        require(name in found, f"the array {name} is missing")
        require(name in expected, f"the array {name} has no place in it")
        same = found[name] == expected[name]
        require(same, f"the array {name} has shape {found[name]}; expected {expected[name]}")
        # Numbers of 64 bits may not be finite in the type that they are used in.
        with np.errstate(over="ignore"):
            leaves[name] = arrays[name].astype(jnp.result_type(float))
        require(bool(np.isfinite(leaves[name]).all()), f"the array {name} has entries that are not finite")
    temperature = leaves.get("temperature")
    require(temperature is None or bool(temperature > 0), f"the temperature is {temperature}; it must be positive")
    return jax.tree.unflatten(jax.tree.structure(blank), [jnp.asarray(leaves[name]) for name in expected])


def _named(network: Any) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(network)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]
