"""Describes configurations as JSON. `jaxnbv.storage.rebuilding` is the inverse."""

import dataclasses
import enum
import functools
import hashlib
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import PurePath
from types import FunctionType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.errors import InputError
from jaxnbv.storage.code import closure, is_installed, is_plain, is_written, lookup, name_of, reads_of, source_of

_LARGEST_LISTED = 16
# Classes of objects that wrap functions, some with custom derivatives for JAX.
_WRAPPERS = {"PjitFunction", "custom_jvp", "custom_vjp", "_JitWrapper", "BoundMethod", "_lru_cache_wrapper"} | {
    kind.__name__ for kind in (functools.cached_property, classmethod, property, staticmethod)
}
_FUNCTIONS = ("__func__", "fget", "func", "fun", "jvp", "fwd", "bwd", "__wrapped__")


def describe(thing: Any, arrays: dict[str, np.ndarray] | None = None, way: str = "") -> Any:
    """Describe a configuration as JSON. Different configurations have different descriptions.

    `rebuild` is the inverse. Equinox modules, dataclasses and named tuples are described by their classes and fields,
    small arrays by their values, and large arrays by a hash of their bytes. A function is described by its source,
    defaults, closure and all globals that its code reads. The same holds for each method of a user's class. Definitions
    of installed packages are described by their names, and objects with a `version` (a text or a number) by their class
    and version.

    - `arrays`: a dictionary to fill with the contents of the large arrays, keyed by hash.
    - `way`: path of `thing` in a larger configuration, such as "planner.search", for error messages.

    **Raises:** `ValueError` if the state of an object cannot be described, or the source of a function cannot be read,
    and the object or function has no `version`. The error names its path.
    """
    return _Describer({} if arrays is None else arrays).describe(thing, way)


def is_record(kind: type) -> bool:
    """Return whether a class is a dataclass (Equinox modules are dataclasses) or a named tuple."""
    return dataclasses.is_dataclass(kind) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def fields_of(kind: type) -> Sequence[str]:
    """Return the names of the fields of a dataclass or a named tuple."""
    return [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else kind._fields  # type: ignore[attr-defined]


class _Describer:
    """State of one call of `describe`, which describes an object inside itself by a reference."""

    def __init__(self, arrays: dict[str, np.ndarray]):
        self.arrays = arrays
        self.visited: dict[int, tuple[int, Any]] = {}
        self.numbers = itertools.count()

    def describe(self, thing: Any, way: str) -> Any:
        kind = type(thing)
        if thing is None or kind in (bool, int, str) or (kind is float and math.isfinite(thing)):
            return thing
        if kind in (float, complex):
            return {"type": kind.__name__, "value": repr(thing)}
        if kind is bytes:
            return {"type": "bytes", "value": thing.hex()}
        if isinstance(thing, enum.Enum):
            return {"type": name_of(kind), "member": thing.name, "value": self.describe(thing.value, way)}
        if isinstance(thing, PurePath):
            return {"type": "path", "value": str(thing)}
        if isinstance(thing, np.dtype):
            return {"type": "dtype", "value": str(thing)}
        if isinstance(thing, jax.Array | np.generic) or kind is np.ndarray:
            return self._array(thing, way)
        if id(thing) in self.visited:
            return {"type": "again", "name": name_of(thing), "index": self.visited[id(thing)][0]}
        self.visited[id(thing)] = next(self.numbers), thing
        try:
            return self._object(thing, kind, way)
        finally:
            # Only code is described once per call. Equal containers are described alike, whether or not they are the
            # same object.
            if not isinstance(thing, FunctionType | type):
                del self.visited[id(thing)]

    def _object(self, thing: Any, kind: type, way: str) -> Any:
        version = None if isinstance(thing, ModuleType) else getattr(thing, "version", None)
        versioned = isinstance(version, str | int | float)
        wraps = kind.__name__ in _WRAPPERS and is_installed(kind.__module__)
        if is_record(kind) and not wraps:
            code = {} if is_installed(kind.__module__) else {"class": self.describe(kind, f"{way}.class")}
            values = {name: getattr(thing, name) for name in fields_of(kind)}
            # The version is described instead of fields that are functions.
            state = {name: value for name, value in values.items() if not (versioned and callable(value))}
            return {"type": name_of(kind), **code, **self._named(state, way)}
        if versioned:
            return {"type": "versioned", "name": name_of(thing) or name_of(kind), "version": version}
        if kind is dict:
            if all(type(key) is str for key in thing) and "type" not in thing:
                return self._named(thing, way)
            return {"type": "dict", "items": self.describe(tuple(thing.items()), way)}
        if kind is tuple:
            return [self.describe(value, f"{way}[{index}]") for index, value in enumerate(thing)]
        if kind is list:
            return {"type": "list", "items": self.describe(tuple(thing), way)}
        if kind in (set, frozenset):
            items = [self.describe(value, way) for value in thing]
            return {"type": kind.__name__, "items": sorted(items, key=lambda item: json.dumps(item, sort_keys=True))}
        if isinstance(thing, ModuleType):
            own = {} if is_installed(thing.__name__) else {"version": getattr(thing, "__version__", None)}
            return {"type": "module", "name": thing.__name__, **own}
        name = name_of(thing)
        if is_installed(name.partition(":")[0]) and lookup(name) is thing:
            return {"type": "class" if isinstance(thing, type) else "function", "name": name}
        if isinstance(thing, type):
            parts = {"members": {key: value for key, value in vars(thing).items() if is_written(key, value)}}
            return {"type": "class", "name": name, **self._beside({**parts, "bases": thing.__bases__}, way)}
        if isinstance(thing, functools.partial):
            return {"type": "partial", **self._named({"function": thing.func, "arguments": thing.args}, way)} | {
                "keywords": self.describe(thing.keywords, way)
            }
        bound = getattr(thing, "__self__", None)
        if bound is not None and not isinstance(bound, ModuleType):
            function = getattr(thing, "__func__", None) or getattr(type(bound), thing.__name__)
            return {"type": "method", **self._named({"function": function, "self": bound}, way)}
        if isinstance(thing, FunctionType):
            return {"type": "function", "name": name, **self._function(thing, way)}
        if wraps:
            functions = {part: value for part in _FUNCTIONS if callable(value := getattr(thing, part, None))}
            return {"type": "wrapped", "by": name_of(kind), "name": name, **self._named(functions, way)}
        if is_installed(kind.__module__) and is_plain(thing):
            return {"type": name_of(kind), **self._beside({"state": getattr(thing, "__dict__", {})}, way)}
        raise InputError(
            f"{way or 'this'} is a {kind.__name__}, which cannot be told apart from another {kind.__name__}: give it "
            "an attribute version, a text or a number that you change whenever it changes, or wrap a network from "
            'outside JAX as HostClassifier(..., version="2026-11")'
        )

    def _array(self, thing: Any, way: str) -> Any:
        if isinstance(thing, jax.Array) and jnp.issubdtype(thing.dtype, jax.dtypes.prng_key):
            return {"type": f"key {jax.random.key_impl(thing)}", "data": jax.random.key_data(thing).tolist()}
        origin = "jax" if isinstance(thing, jax.Array) else "numpy" if isinstance(thing, np.ndarray) else "scalar"
        array = np.ascontiguousarray(thing).reshape(np.shape(thing))
        if array.dtype.hasobject:
            raise InputError(f"{way or 'this'} is an array of Python objects: give numbers")
        # A "weak" JAX scalar was made from a Python number, and does not promote the types of other arrays.
        kind = f"{'weak' if array.ndim == 0 and getattr(thing, 'weak_type', False) else origin} {array.dtype}"
        if 0 < array.size <= _LARGEST_LISTED and array.dtype.kind in "biuf" and np.isfinite(array).all():
            return {"type": kind, "values": array.tolist()}
        digest = hashlib.sha256(array.tobytes()).hexdigest()
        self.arrays[digest] = array
        return {"type": kind, "shape": list(array.shape), "sha256": digest}

    def _named(self, values: dict[str, Any], way: str) -> dict[str, Any]:
        return {name: self.describe(value, f"{way}.{name}".lstrip(".")) for name, value in values.items()}

    def _function(self, function: FunctionType, way: str) -> dict[str, Any]:
        """Describe all that a function's result depends on, except definitions of installed packages."""
        own = not is_installed(function.__globals__.get("__name__"))
        parts = {"defaults": (function.__defaults__, function.__kwdefaults__), "closure": closure(function)}
        if own:
            reads = dict(reads_of(function.__code__, function.__globals__, way))
            parts["globals"] = {name: reads[name] for name in sorted(reads)}
        source = {"source": source_of(function, way)} if own or function.__name__ == "<lambda>" else {}
        return source | self._beside(parts, way)

    def _beside(self, parts: dict[str, Any], way: str) -> dict[str, Any]:
        """Describe parts of code without storing their arrays, since `rebuild` looks up code by name."""
        arrays, self.arrays = self.arrays, {}
        try:
            return self._named(parts, way)
        finally:
            self.arrays = arrays
