"""The arrays of our own networks by name, for safetensors files, and the networks that they make.

Names are attribute paths such as `pattern.pair.weight`; widths are those of the class. Of a classifier the metadata
hold the names of its classes, where it has some, the radii and the numbers of groups of its levels, and the points that
a focused one is fed, separated by commas.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import require
from jaxnbv.networks.compact_segmenter import CompactPartSegmenter
from jaxnbv.networks.invariant import Focus, FocusedClassifier, InvariantClassifier

NativeNetwork = InvariantClassifier | FocusedClassifier | CompactPartSegmenter


def arrays_of(network: NativeNetwork) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The network's arrays by name, and the file's metadata."""
    arrays = {name: np.asarray(leaf) for name, leaf in _named(network)}
    said: dict[str, str] = {}
    if isinstance(network, FocusedClassifier):
        said, network = {"points": str(network.num_points)}, network.network
    if isinstance(network, InvariantClassifier):
        levels = network.edge, network.pattern
        said |= {"radii": _listed(one.radius for one in levels), "groups": _listed(one.groups for one in levels)}
        said |= {} if network.classes is None else {"classes": _listed(network.classes)}
    return arrays, said


def is_native(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether the names are those of one of our own networks."""
    return any(name.startswith(("edge.", "fine.", "focus.")) for name in arrays)


def build_native(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> NativeNetwork:
    """The network that the arrays make.

    **Raises:** `ValueError` for shapes that are not the network's, another number of names, or entries not finite.
    """
    if any(name.startswith("fine.") for name in arrays):
        return _filled(eqx.filter_eval_shape(CompactPartSegmenter, jax.random.key(0)), arrays)
    focused = any(name.startswith("focus.") for name in arrays)
    last_name = f"{'network.' if focused else ''}head.1.bias"
    last = arrays.get(last_name, np.zeros(0))
    require(last.ndim == 1 and last.size > 0, f"the array {last_name}, of one entry a class, is missing")
    said: dict[str, Any] = {"classes": tuple(metadata["classes"].split(","))} if "classes" in metadata else {}
    said |= {name: _numbers(metadata, name, *kind) for name, kind in _LEVELS.items() if name in metadata}
    points = _numbers(metadata, "points", int, 1) if "points" in metadata else ()

    def blank():
        network = InvariantClassifier(last.size, jax.random.key(0), **said)
        return FocusedClassifier(Focus(jax.random.key(0)), network, *points) if focused else network

    return _filled(eqx.filter_eval_shape(blank), arrays)


# What the metadata say of the two levels.
_LEVELS = {"radii": (float, 2), "groups": (int, 2)}


def _listed(values: Iterable[Any]) -> str:
    return ",".join(map(str, values))


def _numbers(metadata: Mapping[str, str], name: str, kind: Callable[[str], Any], count: int) -> tuple[Any, ...]:
    words = metadata[name].split(",")
    try:
        numbers = tuple(map(kind, words))
    except ValueError:
        numbers = ()
    require(len(numbers) == count, f"its metadata say {name}={metadata[name]!r}; expected numbers, {count} of them")
    return numbers


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
    temperature = leaves.get("temperature", leaves.get("network.temperature"))
    require(temperature is None or bool(temperature > 0), f"the temperature is {temperature}; it must be positive")
    return jax.tree.unflatten(jax.tree.structure(blank), [jnp.asarray(leaves[name]) for name in expected])


def _named(network: Any) -> list[tuple[str, Any]]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(network)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), leaf) for path, leaf in leaves]
