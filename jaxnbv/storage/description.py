"""A description of any configuration that JSON can say."""

import dataclasses
import functools
import hashlib
import json
from types import CodeType, FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LARGEST_LISTED = 16


def describe(thing: Any) -> Any:
    """A JSON description by which two configurations can be told apart.

    Modules and dataclasses become their fields, small arrays their values, large ones a hash of their bytes, functions
    their names and a hash of their code, defaults and closures, other objects their types' names.
    """
    if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        fields = {field.name: describe(getattr(thing, field.name, None)) for field in dataclasses.fields(thing)}
        return {"type": type(thing).__qualname__, **fields}
    if isinstance(thing, jax.Array) and jnp.issubdtype(thing.dtype, jax.dtypes.prng_key):
        return {"type": str(jax.random.key_impl(thing)), "data": jax.random.key_data(thing).tolist()}
    if isinstance(thing, jax.Array | np.ndarray | np.generic):
        array = np.asarray(thing)
        if array.size <= _LARGEST_LISTED:
            return array.tolist()
        digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return {"shape": list(array.shape), "dtype": str(array.dtype), "sha256": digest}
    if isinstance(thing, dict):
        return {str(key): describe(value) for key, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [describe(value) for value in thing]
    if thing is None or isinstance(thing, bool | int | float | str):
        return thing
    if isinstance(thing, functools.partial):
        return {"partial": describe(thing.func), "arguments": describe([thing.args, thing.keywords])}
    if isinstance(thing, FunctionType):
        cells = [cell.cell_contents for cell in thing.__closure__ or ()]
        parts = [
            thing.__code__,
            thing.__defaults__,
            thing.__kwdefaults__,
            [cell for cell in cells if cell is not thing],
        ]
        digest = hashlib.sha256(json.dumps(describe(parts)).encode()).hexdigest()
        return {"function": thing.__qualname__, "sha256": digest}
    if isinstance(thing, CodeType):
        return describe([thing.co_code, thing.co_names, thing.co_consts])
    if isinstance(thing, set | frozenset):
        return sorted(map(repr, thing))
    if isinstance(thing, bytes | complex):
        return repr(thing)
    if hasattr(thing, "__wrapped__"):
        return describe(thing.__wrapped__)
    return getattr(thing, "__qualname__", type(thing).__qualname__)
