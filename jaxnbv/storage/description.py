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
from jaxnbv.storage.code import (
    closure,
    globals_read,
    is_installed,
    is_plain,
    is_user_defined,
    lookup,
    name_of,
    source_of,
)

_MAX_LISTED = 16
# Names of the classes whose objects wrap functions, and the attributes in which the objects hold the functions.
_WRAPPERS = {"PjitFunction", "custom_jvp", "custom_vjp", "_JitWrapper", "BoundMethod", "_lru_cache_wrapper"} | {
    kind.__name__ for kind in (functools.cached_property, classmethod, property, staticmethod)
}
_FUNCTIONS = ("__func__", "fget", "func", "fun", "jvp", "fwd", "bwd", "__wrapped__")


def describe(obj: Any, arrays: dict[str, np.ndarray] | None = None, path: str = "") -> Any:
    """Describe a configuration as JSON. Different configurations have different descriptions.

    `rebuild` is the inverse. Equinox modules, dataclasses and named tuples are described by their classes and fields,
    small arrays by their values, and large arrays by a hash of their bytes. A function is described by its source,
    defaults, closure and all globals that its code reads. Each method of a user's class is described like a function.
    Definitions of installed packages are described by their names, and objects with a `version` (a text or a number) by
    their class and version.

    - `arrays`: a dictionary to fill with the contents of the large arrays, keyed by hash.
    - `path`: path of `obj` in a larger configuration, such as "planner.search", for error messages.

    **Raises:** `ValueError` for an object without a `version` whose state cannot be described, and for a function
    without a `version` whose source cannot be read. The message contains the path of the object or function.
    """
    return _Describer({} if arrays is None else arrays).describe(obj, path)


def is_record(kind: type) -> bool:
    """Return whether a class is a dataclass (Equinox modules are dataclasses) or a named tuple."""
    return dataclasses.is_dataclass(kind) or (issubclass(kind, tuple) and hasattr(kind, "_fields"))


def fields_of(kind: type) -> Sequence[str]:
    """Return the names of the fields of a dataclass or a named tuple."""
    return [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else kind._fields  # type: ignore[attr-defined]


class _Describer:
    """State of one call of `describe`.

    A reference describes an object inside itself, and a function or class that has been described before.
    """

    def __init__(self, arrays: dict[str, np.ndarray]):
        self.arrays = arrays
        self.visited: dict[int, tuple[int, Any]] = {}
        self.numbers = itertools.count()

    def describe(self, obj: Any, path: str) -> Any:
        kind = type(obj)
        if obj is None or kind in (bool, int, str) or (kind is float and math.isfinite(obj)):
            return obj
        if kind in (float, complex):
            return {"type": kind.__name__, "value": repr(obj)}
        if kind is bytes:
            return {"type": "bytes", "value": obj.hex()}
        if isinstance(obj, enum.Enum):
            return {"type": name_of(kind), "member": obj.name, "value": self.describe(obj.value, path)}
        if isinstance(obj, PurePath):
            return {"type": "path", "value": str(obj)}
        if isinstance(obj, np.dtype):
            return {"type": "dtype", "value": str(obj)}
        if isinstance(obj, jax.Array | np.generic) or kind is np.ndarray:
            return self._describe_array(obj, path)
        if id(obj) in self.visited:
            return {"type": "again", "name": name_of(obj), "index": self.visited[id(obj)][0]}
        self.visited[id(obj)] = next(self.numbers), obj
        try:
            return self._describe_object(obj, kind, path)
        finally:
            # Only functions and classes are described once and then by reference. Other objects are described anew, so
            # that the description does not depend on whether two equal objects are the same object.
            if not isinstance(obj, FunctionType | type):
                del self.visited[id(obj)]

    def _describe_object(self, obj: Any, kind: type, path: str) -> Any:
        version = None if isinstance(obj, ModuleType) else getattr(obj, "version", None)
        has_version = isinstance(version, str | int | float)
        is_wrapper = kind.__name__ in _WRAPPERS and is_installed(kind.__module__)
        if is_record(kind) and not is_wrapper:
            code = {} if is_installed(kind.__module__) else {"class": self.describe(kind, f"{path}.class")}
            values = {name: getattr(obj, name) for name in fields_of(kind)}
            # If there is a version, leave out fields that are functions, because the version stands for them.
            state = {name: value for name, value in values.items() if not (has_version and callable(value))}
            return {"type": name_of(kind), **code, **self._describe_values(state, path)}
        if has_version:
            return {"type": "versioned", "name": name_of(obj) or name_of(kind), "version": version}
        if kind is dict:
            if all(type(key) is str for key in obj) and "type" not in obj:
                return self._describe_values(obj, path)
            return {"type": "dict", "items": self.describe(tuple(obj.items()), path)}
        if kind is tuple:
            return [self.describe(value, f"{path}[{index}]") for index, value in enumerate(obj)]
        if kind is list:
            return {"type": "list", "items": self.describe(tuple(obj), path)}
        if kind in (set, frozenset):
            items = [self.describe(value, path) for value in obj]
            return {"type": kind.__name__, "items": sorted(items, key=lambda item: json.dumps(item, sort_keys=True))}
        if isinstance(obj, ModuleType):
            fields = {} if is_installed(obj.__name__) else {"version": getattr(obj, "__version__", None)}
            return {"type": "module", "name": obj.__name__, **fields}
        name = name_of(obj)
        if is_installed(name.partition(":")[0]) and lookup(name) is obj:
            return {"type": "class" if isinstance(obj, type) else "function", "name": name}
        if isinstance(obj, type):
            parts = {"members": {key: value for key, value in vars(obj).items() if is_user_defined(key, value)}}
            return {"type": "class", "name": name, **self._without_arrays({**parts, "bases": obj.__bases__}, path)}
        if isinstance(obj, functools.partial):
            parts = self._describe_values({"function": obj.func, "arguments": obj.args}, path)
            return {"type": "partial", **parts, "keywords": self.describe(obj.keywords, path)}
        instance = getattr(obj, "__self__", None)
        if instance is not None and not isinstance(instance, ModuleType):
            function = getattr(obj, "__func__", None) or getattr(type(instance), obj.__name__)
            return {"type": "method", **self._describe_values({"function": function, "self": instance}, path)}
        if isinstance(obj, FunctionType):
            return {"type": "function", "name": name, **self._describe_function(obj, path)}
        if is_wrapper:
            functions = {part: value for part in _FUNCTIONS if callable(value := getattr(obj, part, None))}
            return {"type": "wrapped", "by": name_of(kind), "name": name, **self._describe_values(functions, path)}
        if is_installed(kind.__module__) and is_plain(obj):
            return {"type": name_of(kind), **self._without_arrays({"state": getattr(obj, "__dict__", {})}, path)}
        raise InputError(
            f"{path or 'this'} is a {kind.__name__}, which cannot be told apart from another {kind.__name__}: give it "
            "an attribute version, a text or a number that you change whenever it changes, or wrap a network from "
            'outside JAX as HostClassifier(..., version="2026-11")'
        )

    def _describe_array(self, obj: Any, path: str) -> Any:
        if isinstance(obj, jax.Array) and jnp.issubdtype(obj.dtype, jax.dtypes.prng_key):
            return {"type": f"key {jax.random.key_impl(obj)}", "data": jax.random.key_data(obj).tolist()}
        origin = "jax" if isinstance(obj, jax.Array) else "numpy" if isinstance(obj, np.ndarray) else "scalar"
        array = np.ascontiguousarray(obj).reshape(np.shape(obj))
        if array.dtype.hasobject:
            raise InputError(f"{path or 'this'} is an array of Python objects: give numbers")
        # A "weak" JAX scalar was made from a Python number, and does not promote the types of other arrays.
        kind = f"{'weak' if array.ndim == 0 and getattr(obj, 'weak_type', False) else origin} {array.dtype}"
        if 0 < array.size <= _MAX_LISTED and array.dtype.kind in "biuf" and np.isfinite(array).all():
            return {"type": kind, "values": array.tolist()}
        digest = hashlib.sha256(array.tobytes()).hexdigest()
        self.arrays[digest] = array
        return {"type": kind, "shape": list(array.shape), "sha256": digest}

    def _describe_values(self, values: dict[str, Any], path: str) -> dict[str, Any]:
        return {name: self.describe(value, f"{path}.{name}".lstrip(".")) for name, value in values.items()}

    def _describe_function(self, function: FunctionType, path: str) -> dict[str, Any]:
        """Describe everything that a function's result depends on, except definitions of installed packages."""
        is_user_code = not is_installed(function.__globals__.get("__name__"))
        parts = {"defaults": (function.__defaults__, function.__kwdefaults__), "closure": closure(function)}
        if is_user_code:
            values = dict(globals_read(function.__code__, function.__globals__, path))
            parts["globals"] = {name: values[name] for name in sorted(values)}
        source = {"source": source_of(function, path)} if is_user_code or function.__name__ == "<lambda>" else {}
        return source | self._without_arrays(parts, path)

    def _without_arrays(self, parts: dict[str, Any], path: str) -> dict[str, Any]:
        """Describe the parts of a function or class without storing arrays, which `rebuild` does not need."""
        arrays, self.arrays = self.arrays, {}
        try:
            return self._describe_values(parts, path)
        finally:
            self.arrays = arrays
