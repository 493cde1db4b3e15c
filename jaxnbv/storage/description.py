"""A description of any configuration that JSON can say."""

import dataclasses
import functools
import hashlib
import inspect
import textwrap
import warnings
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_LARGEST_LISTED = 16


def describe(thing: Any) -> Any:
    """A JSON description by which two configurations can be told apart.

    Modules and dataclasses become their fields, small arrays their values, large ones a hash of their bytes, functions
    their names, source, defaults and closures, other objects their types' names. Where the source of a function cannot
    be read, a `UserWarning` says so, and its name must do.
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
        parts = {
            "source": _source(thing),
            "defaults": [thing.__defaults__, thing.__kwdefaults__],
            "closure": [cell for cell in cells if cell is not thing],
        }
        return {"function": thing.__qualname__, **describe(parts)}
    if isinstance(thing, set | frozenset):
        return sorted(map(repr, thing))
    if isinstance(thing, bytes | complex):
        return repr(thing)
    if hasattr(thing, "__wrapped__"):
        return describe(thing.__wrapped__)
    return getattr(thing, "__qualname__", type(thing).__qualname__)


def _source(function: FunctionType) -> str | None:
    """The text of a function; of a lambda its body alone, for a line may hold several."""
    try:
        text = textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        warnings.warn(
            f"the source of the function {function.__qualname__} cannot be read: its name alone says whether a stored "
            "run is of the same function. Define it in a file",
            stacklevel=2,
        )
        return None
    if function.__name__ != "<lambda>":
        return text
    lines, _ = inspect.findsource(function)
    # An instruction without width is of no expression.
    spans = [(a, b, c, d) for a, b, c, d in function.__code__.co_positions() if a and b and c is not None and d]
    (first, start), (last, end) = min((a, c) for a, _, c, _ in spans), max((b, d) for _, b, _, d in spans)
    body = [line.encode() for line in lines[first - 1 : last]]
    body[-1] = body[-1][:end]
    body[0] = body[0][start:]
    return b"".join(body).decode()
