"""Checks of arguments and fields. Traced values are not checked. Errors name the value and the remedy."""

import dataclasses
import functools
import inspect
import numbers
import os
import traceback
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import equinox
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
from jax import Array

from jaxnbv.errors import InputError as InputError
from jaxnbv.errors import install

AnyArray = Array | np.ndarray
_F = TypeVar("_F", bound=Callable[..., Any])
_MAX_TEXT_LENGTH = 60
_hints_of = functools.cache(get_type_hints)
_LIBRARY_FOLDERS = tuple(
    f"{Path(str(file)).parent}{os.sep}" for file in (jax.__file__, equinox.__file__, jaxtyping.__file__, __file__)
)
_NUMBERS = {tuple[float, float]: "two", tuple[float, float, float]: "three"}
_REAL = (jnp.bool_, jnp.integer, jnp.floating)
# For each JAX tracing error, the operation that causes it and the remedy.
_UNTRACEABLE: dict[type[Exception], tuple[str, str]] = {
    jax.errors.TracerArrayConversionError: ("calls NumPy or other code outside JAX", "write it with jax.numpy"),
    jax.errors.NonConcreteBooleanIndexError: (
        "picks rows by a mask, and JAX cannot know their number",
        "keep all rows and use jnp.where(cloud.mask, ..., 0.0), or jnp.mean(..., where=cloud.mask)",
    ),
    jax.errors.TracerIntegerConversionError: (
        "counts or indexes in Python with a value that JAX traces",
        "write it with jax.numpy, or jax.lax.fori_loop",
    ),
    jax.errors.ConcretizationTypeError: (
        "branches in Python on a value that JAX traces",
        "write it with jnp.where, or jax.lax.cond",
    ),
}
# The largest 32-bit float. Conversion to 32 bits makes larger numbers infinite.
_MAX_FLOAT = float(np.finfo(np.float32).max)


def check_device() -> None:
    """Raise `ValueError` if JAX finds no device of the platform that `JAX_PLATFORMS` names."""
    try:
        jax.devices()
    # The type of the error depends on the plugins that are installed.
    except Exception as error:
        raise InputError(
            f"JAX_PLATFORMS is {os.environ.get('JAX_PLATFORMS', '')!r}, but JAX finds no such device here: leave it "
            f"out, or check the device's driver and run {install('cuda')}"
        ) from error


def require(condition: bool | np.bool_, message: str) -> None:
    """Raise `InputError(message)` unless the condition holds."""
    if not condition:
        raise InputError(message)


def is_traced(*trees) -> bool:
    """Return whether any leaf of the trees is a tracer, JAX's stand-in for a value under `jit` or `grad`."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def check_fields(module: Any) -> None:
    """Raise `ValueError` if a field of a module contradicts its annotation, see `check_type`.

    Call this first in `__check_init__`.
    """
    hints = get_type_hints(type(module))
    for field in dataclasses.fields(module):
        check_type(getattr(module, field.name, None), hints[field.name], f"{type(module).__name__}'s {field.name}")


@contextmanager
def own_settings() -> Iterator[None]:
    """Context manager or decorator: allow rank promotion, type promotion and transfers in JAX.

    A user's strict settings in `jax.config` are meant for the user's own code. `jax_debug_nans` is not changed.
    """
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"), jax.transfer_guard("allow"):
        yield


def checked(function: _F) -> _F:
    """Decorator: check the arguments with `check_type`, and run the function under `own_settings`."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        bound = signature.bind(*arguments, **keywords)
        hints = _hints_of(function)
        for name, value in bound.arguments.items():
            if name in hints:
                owner = type(arguments[0]).__name__ if function.__name__ == "__init__" else function.__name__
                check_type(value, hints[name], f"{owner}'s {name}")
        with own_settings():
            return function(*arguments, **keywords)

    return call  # type: ignore[return-value]


def check_type(value: Any, hint: Any, name: str) -> None:
    """Raise `ValueError` if the value called `name` contradicts a plain type hint.

    Plain hints are int, float, bool, a tuple of two or three floats, classes, `Callable`, and a union with None. Other
    hints are ignored.
    """
    if hint is int:
        is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
        require(is_whole, f"{name} is {short_text(value)}; it must be a whole number")
    elif hint is float:
        require(_is_number(value), f"{name} is {short_text(value)}; it must be a finite number")
    elif hint is bool:
        require(isinstance(value, bool | np.bool_), f"{name} is {short_text(value)}; it must be True or False")
    elif hint in _NUMBERS:
        count = len(get_args(hint))
        is_valid = isinstance(value, tuple | list) and len(value) == count and all(map(_is_number, value))
        require(is_valid, f"{name} is {short_text(value)}; it must be {_NUMBERS[hint]} finite numbers")
    elif isinstance(hint, types.UnionType) and type(None) in (kinds := get_args(hint)) and len(kinds) == 2:
        if value is not None:
            check_type(value, kinds[0] if kinds[1] is type(None) else kinds[1], name)
    elif (kinds := _classes(hint)) and not isinstance(value, kinds):
        class_names = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
        raise InputError(f"{name} is {short_text(value)}; give {class_names}")
    elif get_origin(hint) is Callable and not callable(value):
        raise InputError(f"{name} is {short_text(value)}; give a function")


def check_index(index: Any, batch: tuple[int, ...], name: str) -> None:
    """Raise `ValueError` if `index` is outside the first axis of a batch, or if the batch has no axis.

    JAX would clamp such an index. Only Python and NumPy integers are checked.

    - `batch`: shape of the leading axes of the object called `name`.
    """
    if isinstance(index, int | np.integer):
        check_batch(batch, name)
        require(-batch[0] <= index < batch[0], f"{name} has {batch[0]} along its first axis: there is no index {index}")


def check_batch(batch: tuple[int, ...], name: str) -> None:
    """Raise `ValueError` if `batch`, the shape of the leading axes of the object called `name`, is empty."""
    require(len(batch) > 0, f"{name} is a single one, not a batch: it can be neither indexed nor iterated")


def check_key(key: Any) -> None:
    """Raise `ValueError` unless this is a single typed JAX random key."""
    is_key = isinstance(key, Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
    require(is_key, f"the key is {short_text(key)}: make one with jax.random.key(seed)")


def on_host(tree: Any) -> Any:
    """Convert a tree's leaves to NumPy, which compiles no operations; return a traced tree unchanged."""
    return tree if is_traced(tree) else jax.tree.map(np.asarray, tree)


def native(value: Any) -> Any:
    """Convert a NumPy array to native byte order and at most double precision; return other values as is.

    JAX's `jit` reads an array of non-native byte order without swapping the bytes.
    """
    if isinstance(value, np.ndarray) and (value.dtype.char == "g" or not value.dtype.isnative):
        return value.astype(np.float64 if value.dtype.char == "g" else value.dtype.newbyteorder("="))
    return value


def takes_native(function: _F) -> _F:
    """Decorator: pass all arguments through `native`."""

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        return function(*map(native, arguments), **{name: native(value) for name, value in keywords.items()})

    return call  # type: ignore[return-value]


@own_settings()
def as_floats(value: Any, name: str) -> Array:
    """Return the value, called `name` in errors, as an array of JAX's default floating-point type.

    **Raises:** `ValueError` if the value is not an array of real numbers.
    """
    # A JAX array of real numbers stays on its device.
    is_real = isinstance(value, Array) and any(jnp.issubdtype(value.dtype, kind) for kind in _REAL)
    return jnp.asarray(value if is_real or is_traced(value) else as_numbers(value, name), dtype=jnp.result_type(float))


def as_numbers(value: Any, name: str, dtype: Any = float) -> np.ndarray:
    """Return the value, called `name` in errors, as a NumPy array.

    - `dtype`: type of the result. `float` means JAX's default floating-point type. None keeps the type of the value.

    **Raises:** `ValueError` if the value is not an array of real numbers, or is a masked array with masked entries.
    """
    has_masked = isinstance(value, np.ma.MaskedArray) and bool(np.ma.getmaskarray(value).any())
    require(not has_masked, f"{name} is a masked array: give what is valid in it as a plain array")
    try:
        array = native(np.asarray(value))
        # NumPy itself would also convert text, dates, complex numbers and None.
        is_real = array.dtype.kind in "biuf" or jnp.issubdtype(array.dtype, jnp.floating)
        is_real = is_real or (array.dtype.kind == "O" and all(isinstance(item, numbers.Real) for item in array.flat))
        require(is_real, f"{name} is {short_text(value)}; give real numbers")
        with np.errstate(over="ignore"):
            return array.astype(jnp.result_type(float) if dtype is float else dtype or array.dtype, copy=False)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is {short_text(value)}; give numbers") from error


@contextmanager
def functions_of_users() -> Iterator[None]:
    """Context manager: replace JAX's tracing errors in a user's function by explanations.

    **Raises:** `ValueError` for a function that calls NumPy, selects rows by a mask, or counts, indexes or branches in
    Python with a traced value.
    """
    try:
        yield
    except tuple(_UNTRACEABLE) as error:
        frames = traceback.extract_tb(error.__traceback__)
        frame = next((frame for frame in reversed(frames) if not frame.filename.startswith(_LIBRARY_FOLDERS)), None)
        if frame is None:
            raise
        problem, remedy = next(words for kind, words in _UNTRACEABLE.items() if isinstance(error, kind))
        raise InputError(
            f"{frame.name} {problem} ({frame.filename}:{frame.lineno}): {remedy}, or wrap a network from outside JAX "
            "in HostClassifier or HostSegmenter"
        ) from error


def checked_result(value: Any, name: str, axes: int, requirement: str) -> Any:
    """Check the value that a user's function returned, and return the value.

    - `name`, `requirement`: what the error message calls the value, and the message's description of valid values.
    - `axes`: required number of axes. A plain number has zero axes.

    **Raises:** `ValueError` unless the value is a real number or an array of real numbers, with `axes` axes.
    """
    dtype = getattr(value, "dtype", None)
    is_real = isinstance(value, numbers.Real) if dtype is None else any(jnp.issubdtype(dtype, kind) for kind in _REAL)
    require(is_real and np.ndim(value) == axes, f"{name} is {short_text(value)}: {requirement}")
    return value


def short_text(value: Any) -> str:
    """Return a short text for a value in an error message. An array is described by its shape and type."""
    if isinstance(value, AnyArray):
        return f"an array of shape {value.shape} and type {value.dtype}" if value.ndim else str(value)
    if isinstance(value, str | int | float | complex | tuple | list | dict | None):
        try:
            text = repr(value)
        except RecursionError:
            return f"a {type(value).__name__} that is nested too deep"
        return text if len(text) <= _MAX_TEXT_LENGTH else f"{text[:_MAX_TEXT_LENGTH]}..."
    return f"a {type(value).__name__}" if not isinstance(value, type) else f"the class {value.__name__}"


def _is_number(value: Any) -> bool:
    if is_traced(value):
        return np.ndim(value) == 0
    if isinstance(value, AnyArray) and value.ndim == 0 and getattr(value.dtype, "kind", "") in ("i", "u", "f"):
        value = float(value)
    is_real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return is_real and bool(abs(value) <= _MAX_FLOAT)


def _classes(hint: Any) -> tuple[type, ...]:
    """Return the classes of a hint that is a class or a union of classes; an empty tuple for other hints."""
    kinds = get_args(hint) if isinstance(hint, types.UnionType) or get_origin(hint) is Union else (hint,)
    # Jaxtyping annotations are classes too, but do not count here, because shapes are checked elsewhere.
    is_plain = all(isinstance(kind, type) and not hasattr(kind, "dim_str") and kind is not object for kind in kinds)
    return kinds if is_plain else ()
