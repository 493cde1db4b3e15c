"""Rebuilds configurations from their descriptions. Imports no module outside jaxnbv."""

import dataclasses
import enum
import functools
import hashlib
import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.storage.code import is_installed, lookup, name_of
from jaxnbv.storage.description import describe, fields_of, is_record
from jaxnbv.storage.folders import ARRAYS, check_format, differences, read_arrays, read_record

# Modules of installed packages whose functions have no side effects. Functions of other packages might do anything.
_HARMLESS = ("jaxnbv", "jax.nn", "jax._src.nn", "jax.lax", "equinox.nn", "optimistix", "math")
_TEXTS: dict[str, Callable[[Any], Any]] = {
    "float": float,
    "complex": complex,
    "bytes": bytes.fromhex,
    "path": Path,
    "dtype": np.dtype,
}


def rebuild(description: Any, arrays: Mapping[str, np.ndarray], path: str) -> Any:
    """Rebuild a configuration from the description that `describe` returned.

    Classes and functions are looked up in jaxnbv and in modules that are already imported. No function and no
    constructor is called.

    - `arrays`: contents of the large arrays, keyed by hash, from `describe`.
    - `path`: path of the configuration for error messages, such as "planner". Errors advise the user to pass a
      replacement to `load` under the name before the first dot.

    **Raises:** `ValueError` if a part cannot be rebuilt, or has changed since it was described.
    """
    remedy = f"import its module first, or give it again: load(..., {path.partition('.')[0] or 'planner'}=...)"
    try:
        obj = _Rebuilder(arrays, remedy).rebuild(description, path)
    except InputError:
        raise
    # A description that was edited by hand may raise anything.
    except Exception as error:
        raise InputError(f"{path} cannot be made again from its description ({error}): {remedy}") from error
    changes = differences(description, describe(obj, path=path), path)
    require(not changes, f"{'; '.join(changes[:3])}: the code or a value behind it has changed; {remedy}")
    return obj


def read_config(path: str | Path, kind: str, format: int, replacements: Mapping[str, Any]) -> dict[str, Any]:
    """Rebuild the configuration that the record of an existing folder describes, as parts keyed by name.

    - `kind`, `format`: kind and format of the record, see `ResultFolder`.
    - `replacements`: parts to return as they are instead of rebuilding them, keyed by name. When `RunFolder` opens the
      folder, it checks that they agree with the record.

    **Raises:** `ValueError` if the folder holds no record or a damaged record, or if a part cannot be rebuilt and has
    no replacement.
    """
    folder, remedy = Path(path), "give the folder of a run"
    record = read_record(folder, kind, remedy)
    check_format(record.get("format"), format, folder / f"{kind}.json")
    parts = {name: part for name, part in record["config"].items() if name not in replacements}
    file = folder / ARRAYS
    arrays = read_arrays(file, "restore it", _check_hashes) if file.exists() else {}
    return dict(replacements) | {name: rebuild(part, arrays, name) for name, part in parts.items()}


def _check_hashes(arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        if hashlib.sha256(array.tobytes()).hexdigest() != name:
            raise ValueError(f"the array {name} is another")


class _Rebuilder:
    def __init__(self, arrays: Mapping[str, np.ndarray], remedy: str):
        self.arrays, self.remedy = arrays, remedy

    def rebuild(self, node: Any, path: str) -> Any:
        if isinstance(node, list):
            return tuple(self.rebuild(value, f"{path}[{index}]") for index, value in enumerate(node))
        if not isinstance(node, dict):
            return node
        if "type" not in node:
            return {name: self.rebuild(value, f"{path}.{name}") for name, value in node.items()}
        kind = node["type"]
        if ":" in kind:
            return self._rebuild_record(kind, node, path)
        if kind in _TEXTS:
            return _TEXTS[kind](node["value"])
        if kind in ("list", "set", "frozenset", "dict"):
            collection: Callable[[Any], Any] = {"list": list, "set": set, "frozenset": frozenset, "dict": dict}[kind]
            return collection(self.rebuild(node["items"], path))
        if kind in ("function", "class", "again", "wrapped"):
            obj = self._lookup_code(node["name"], path)
            has_type = kind != "wrapped" or name_of(type(obj)) == node["by"]
            require(
                has_type, f"{path} is a {node.get('by')} of {node['name']} that has no name of its own: {self.remedy}"
            )
            return obj
        if kind == "partial":
            parts = (self.rebuild(node[part], path) for part in ("function", "arguments", "keywords"))
            function, arguments, keywords = parts
            return functools.partial(function, *arguments, **keywords)
        if kind == "method":
            function, instance = self.rebuild(node["function"], path), self.rebuild(node["self"], path)
            has_method = any(member is function for base in type(instance).__mro__ for member in vars(base).values())
            require(has_method, f"{path} is a method that {type(instance).__name__} does not have: {self.remedy}")
            return getattr(instance, function.__name__)
        require(
            " " in kind, f"{path} is a {node.get('name', kind)}, and the folder stores only its {kind}: {self.remedy}"
        )
        origin, dtype = kind.split(" ")
        if origin == "key":
            return jax.random.wrap_key_data(jnp.array(node["data"], jnp.uint32), impl=dtype)
        return self._rebuild_array(origin, np.dtype(dtype), node, path)

    def _rebuild_array(self, origin: str, dtype: np.dtype, node: dict[str, Any], path: str) -> Any:
        if "values" in node:
            array = np.array(node["values"], dtype)
        else:
            digest = node["sha256"]
            require(digest in self.arrays, f"{path} is an array that the folder does not hold: {self.remedy}")
            array = np.frombuffer(self.arrays[digest].tobytes(), dtype).reshape(node["shape"]).copy()
        if origin == "weak":
            return jnp.asarray(array.item())
        return jnp.asarray(array) if origin == "jax" else array[()] if origin == "scalar" else array

    def _rebuild_record(self, name: str, node: dict[str, Any], path: str) -> Any:
        kind = self._lookup(name, path)
        if isinstance(kind, enum.EnumType):
            return kind[node["member"]]
        require(isinstance(kind, type) and is_record(kind), f"{path} is a {name}, which is no dataclass: {self.remedy}")
        absent_fields = [field for field in fields_of(kind) if field not in node]
        require(
            not absent_fields,
            f"{path} is a {name} that was stored without its {', '.join(absent_fields)}: {self.remedy}",
        )
        values = {field: self.rebuild(node[field], f"{path}.{field}") for field in fields_of(kind)}
        if not dataclasses.is_dataclass(kind):
            return tuple.__new__(kind, values.values())
        obj: Any = object.__new__(kind)  # type: ignore[arg-type]
        for field, value in values.items():
            object.__setattr__(obj, field, value)
        # Wrappers of Equinox have the name and docstring of the function that they wrap.
        if is_installed(kind.__module__) and (function := getattr(obj, "__wrapped__", None)) is not None:
            for attribute in functools.WRAPPER_ASSIGNMENTS:
                object.__setattr__(obj, attribute, getattr(function, attribute))
        return obj

    def _lookup_code(self, name: str, path: str) -> Any:
        """Return the function or class with this name, if it is harmless.

        **Raises:** `ValueError` for a class that is not a dataclass, a named tuple or a NumPy scalar, and for a
        function of an installed package that may have side effects.
        """
        obj = self._lookup(name, path)
        module = name.partition(":")[0]
        is_harmless = (
            is_record(obj) or issubclass(obj, np.generic)
            if isinstance(obj, type)
            else not is_installed(module)
            or any(module == prefix or module.startswith(f"{prefix}.") for prefix in _HARMLESS)
            # Ufuncs of NumPy, and the functions of jax.numpy with the same names, have no side effects.
            or (module in ("numpy", "jax.numpy") and isinstance(getattr(np, name.partition(":")[2], None), np.ufunc))
        )
        require(
            is_harmless, f"{path} is {name}, which no configuration that is read from a file may call: {self.remedy}"
        )
        return obj

    def _lookup(self, name: str, path: str) -> Any:
        module = name.partition(":")[0]
        if module.startswith("jaxnbv.") and not module.endswith("__main__"):
            importlib.import_module(module)
        obj = lookup(name)
        if obj is None:
            missing = "has nothing of that name" if module in sys.modules else "is not imported"
            raise InputError(f"{path} is {name}, but {module} {missing}: {self.remedy}")
        return obj
