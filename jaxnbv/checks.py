"""Checks at the boundary: values are checked where they are known, and errors name the value and the remedy."""

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
_LONGEST_SHOWN = 60
_hints_of = functools.cache(get_type_hints)
# Where what runs is not a user's.
_OWN = tuple(
    f"{Path(str(file)).parent}{os.sep}" for file in (jax.__file__, equinox.__file__, jaxtyping.__file__, __file__)
)
_NUMBERS = {tuple[float, float]: "two", tuple[float, float, float]: "three"}
_REAL = (jnp.bool_, jnp.integer, jnp.floating)
# What a function does that JAX cannot trace, by JAX's errors, and what to do instead.
_UNTRACEABLE: dict[type[Exception], tuple[str, str]] = {
    jax.errors.TracerArrayConversionError: ("calls NumPy or other code outside JAX", "write it with jax.numpy"),
    jax.errors.NonConcreteBooleanIndexError: (
        "picks rows by a mask, of which JAX cannot know how many there are",
        "keep all rows and leave out by jnp.where(cloud.mask, ..., 0.0), or jnp.mean(..., where=cloud.mask)",
    ),
    jax.errors.TracerIntegerConversionError: (
        "counts or indexes in Python by a value that JAX traces",
        "write it with jax.numpy, or jax.lax.fori_loop",
    ),
    jax.errors.ConcretizationTypeError: (
        "decides in Python by a value that JAX traces",
        "write it with jnp.where, or jax.lax.cond",
    ),
}
# Of 32 bits. What is larger is infinite there.
_LARGEST = float(np.finfo(np.float32).max)


def check_device() -> None:
    """**Raises:** `ValueError` if JAX finds no device of the kind that JAX_PLATFORMS asks for."""
    try:
        jax.devices()
    # With a plugin or without, they are of several kinds.
    except Exception as error:
        raise InputError(
            f"JAX_PLATFORMS is {os.environ.get('JAX_PLATFORMS', '')!r}, but JAX finds no such device here: leave it "
            f"out, or see to the device's driver and {install('cuda')}"
        ) from error


def require(condition: bool | np.bool_, message: str) -> None:
    """Raise `InputError(message)` unless the condition holds."""
    if not condition:
        raise InputError(message)


def is_traced(*trees) -> bool:
    """Whether any leaf is a tracer, that is, has no value yet because a JAX transformation is under way."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def check_fields(module: Any) -> None:
    """Check what is annotated by a plain type: whole numbers, numbers, truths, text, and instances of classes.

    To be called first in `__check_init__`, so that the checks after it compare numbers with numbers.

    **Raises:** `ValueError` that names the field.
    """
    hints = get_type_hints(type(module))
    for field in dataclasses.fields(module):
        check_type(getattr(module, field.name, None), hints[field.name], f"{type(module).__name__}'s {field.name}")


@contextmanager
def own_settings() -> Iterator[None]:
    """Where JAX promotes ranks and types and moves arrays as this package expects, whatever `jax.config` says. Also a
    decorator of a function.

    A user's strict settings are for code of the user's. `jax_debug_nans` stays as it is.
    """
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"), jax.transfer_guard("allow"):
        yield


def checked(function: _F) -> _F:
    """A function whose arguments are checked as the fields of a module are, and which has JAX's `own_settings`."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        bound = signature.bind(*arguments, **named)
        hints = _hints_of(function)
        for name, value in bound.arguments.items():
            if name in hints:
                owner = type(arguments[0]).__name__ if function.__name__ == "__init__" else function.__name__
                check_type(value, hints[name], f"{owner}'s {name}")
        with own_settings():
            return function(*arguments, **named)

    return call  # type: ignore[return-value]


def check_type(value: Any, hint: Any, name: str) -> None:
    """**Raises:** `ValueError` unless the value is what a plain type hint says; of other hints nothing is known."""
    if hint is int:
        whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
        require(whole, f"{name} is {shown(value)}; it must be a whole number")
    elif hint is float:
        require(_is_number(value), f"{name} is {shown(value)}; it must be a finite number")
    elif hint is bool:
        require(isinstance(value, bool | np.bool_), f"{name} is {shown(value)}; it must be True or False")
    elif hint in _NUMBERS:
        count = len(get_args(hint))
        proper = isinstance(value, tuple | list) and len(value) == count and all(map(_is_number, value))
        require(proper, f"{name} is {shown(value)}; it must be {_NUMBERS[hint]} finite numbers")
    elif isinstance(hint, types.UnionType) and type(None) in (kinds := get_args(hint)) and len(kinds) == 2:
        if value is not None:
            check_type(value, kinds[0] if kinds[1] is type(None) else kinds[1], name)
    elif (kinds := _classes(hint)) and not isinstance(value, kinds):
        wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
        raise InputError(f"{name} is {shown(value)}; give {wanted}")
    elif get_origin(hint) is Callable and not callable(value):
        raise InputError(f"{name} is {shown(value)}; give a function")


def check_index(index: Any, batch: tuple[int, ...], name: str) -> None:
    """**Raises:** `ValueError` for a number into what is no batch, or beyond its length, which JAX would clamp."""
    if isinstance(index, int | np.integer):
        check_batch(batch, name)
        require(-batch[0] <= index < batch[0], f"{name} has {batch[0]} along its first axis: there is no index {index}")


def check_batch(batch: tuple[int, ...], name: str) -> None:
    """**Raises:** `ValueError` for what has no axes of a batch."""
    require(len(batch) > 0, f"{name} is a single one, not a batch: it can be neither indexed nor iterated")


def check_key(key: Any) -> None:
    """**Raises:** `ValueError` for what is not one key of JAX's random numbers."""
    known = isinstance(key, Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim == 0
    require(known, f"the key is {shown(key)}: make one with jax.random.key(seed)")


def native(value: Any) -> Any:
    """An array of NumPy's in the byte order and precision that JAX has; anything else as it is. Under `jit` JAX reads
    the bytes of another order as if they were in its own."""
    if isinstance(value, np.ndarray) and (value.dtype.char == "g" or not value.dtype.isnative):
        return value.astype(np.float64 if value.dtype.char == "g" else value.dtype.newbyteorder("="))
    return value


def takes_native(function: _F) -> _F:
    """A function whose arguments pass through `native`."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return function(*map(native, arguments), **{name: native(value) for name, value in named.items()})

    return call  # type: ignore[return-value]


@own_settings()
def as_floats(value: Any, name: str) -> Array:
    """The numbers as an array of JAX's default floating-point type.

    **Raises:** `ValueError` for what is not an array of numbers.
    """
    # An array of real numbers that lies on a device stays there.
    known = isinstance(value, Array) and any(jnp.issubdtype(value.dtype, kind) for kind in _REAL)
    return jnp.asarray(value if known or is_traced(value) else as_numbers(value, name), dtype=jnp.result_type(float))


def as_numbers(value: Any, name: str, dtype: Any = float) -> np.ndarray:
    """The numbers as a NumPy array of this type: `float` is JAX's default one, None that which they have.

    **Raises:** `ValueError` for what is not an array of numbers, and for a masked array of which something is masked.
    """
    masked = isinstance(value, np.ma.MaskedArray) and bool(np.ma.getmaskarray(value).any())
    require(not masked, f"{name} is a masked array: give what is valid of it as a plain one")
    try:
        found = native(np.asarray(value))
        # Of text, dates, complex numbers and None NumPy would make numbers.
        real = found.dtype.kind in "biuf" or jnp.issubdtype(found.dtype, jnp.floating)
        real = real or (found.dtype.kind == "O" and all(isinstance(item, numbers.Real) for item in found.flat))
        require(real, f"{name} is {shown(value)}; give real numbers")
        with np.errstate(over="ignore"):
            return found.astype(jnp.result_type(float) if dtype is float else dtype or found.dtype, copy=False)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is {shown(value)}; give numbers") from error


@contextmanager
def functions_of_users() -> Iterator[None]:
    """Where functions of the user's run under JAX: what they do that it cannot trace is one error with its remedy.

    **Raises:** `ValueError` for a function that calls NumPy, picks rows by a mask, or decides in Python by a value.
    """
    try:
        yield
    except tuple(_UNTRACEABLE) as error:
        theirs = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(_OWN)]
        if not theirs:
            raise
        at = f"{theirs[-1].filename}:{theirs[-1].lineno}"
        problem, remedy = next(words for kind, words in _UNTRACEABLE.items() if isinstance(error, kind))
        raise InputError(
            f"{theirs[-1].name} {problem} ({at}): {remedy}, or wrap a network that is not of JAX in HostClassifier or "
            "HostSegmenter"
        ) from error


def returned(value: Any, name: str, axes: int, wanted: str) -> Any:
    """What a function of the user's gave, as it is.

    - `name`: of what it gave, and `wanted`: what it should give, for the error.

    **Raises:** `ValueError` unless it is an array of real numbers with so many axes, or a number for none.
    """
    dtype = getattr(value, "dtype", None)
    real = isinstance(value, numbers.Real) if dtype is None else any(jnp.issubdtype(dtype, kind) for kind in _REAL)
    require(real and np.ndim(value) == axes, f"{name} is {shown(value)}: {wanted}")
    return value


def shown(value: Any) -> str:
    """A value in an error: short, and of an array its shape."""
    if isinstance(value, AnyArray):
        return f"an array of shape {value.shape} and type {value.dtype}" if value.ndim else str(value)
    if isinstance(value, str | int | float | complex | tuple | list | dict | None):
        try:
            text = repr(value)
        except RecursionError:
            return f"a {type(value).__name__} that is nested too deep"
        return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."
    return f"a {type(value).__name__}" if not isinstance(value, type) else f"the class {value.__name__}"


def _is_number(value: Any) -> bool:
    if is_traced(value):
        return np.ndim(value) == 0
    if isinstance(value, AnyArray) and value.ndim == 0 and getattr(value.dtype, "kind", "") in ("i", "u", "f"):
        value = float(value)
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    return real and bool(abs(value) <= _LARGEST)


def _classes(hint: Any) -> tuple[type, ...]:
    """The classes that a hint names, if it names classes alone."""
    kinds = get_args(hint) if isinstance(hint, types.UnionType) or get_origin(hint) is Union else (hint,)
    # A jaxtyping annotation is a class too; what it says of shapes is checked where it matters.
    plain = all(isinstance(kind, type) and not hasattr(kind, "dim_str") and kind is not object for kind in kinds)
    return kinds if plain else ()
