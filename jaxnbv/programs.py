"""Compiled programs that later processes load without tracing them again.

JAX's own cache of compiled programs saves compilation. A later process still traces and lowers each function to find
its entry, which takes longer than everything else in it. A `program` finds its entry from the arguments alone.
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import io
import os
import pickle
import platform
import re
import threading
import time
import types
import uuid
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.sharding import get_abstract_mesh

from jaxnbv.compiled import PROGRAMS

# Code of these decides, with their versions, what a program computes.
_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "optimistix", "lineax", "optax")
_STANDARD = ("builtins", "collections", "copyreg", "functools", "math", "operator", "pathlib")
# The event that JAX's monitoring hears of when a program was loaded.
LOADED = "/jaxnbv/program_load_duration"
_compiling = threading.Lock()


@dataclasses.dataclass(frozen=True)
class _Slot:
    """The place of an array in the result of a program."""

    index: int


class _Executable(NamedTuple):
    """A program for arguments of one kind: the compiled function of their arrays, and its result with slots."""

    call: Callable[[list], list]
    result: Any


class _Program:
    """`eqx.filter_jit` of a function, kept on disk once `keep_compiled` was called."""

    def __init__(self, function: Callable[..., Any]):
        functools.update_wrapper(self, function)
        self._jitted = eqx.filter_jit(function)
        self._function = function
        self._executables: dict[Any, _Executable | None] = {}

    def __get__(self, instance: Any, owner: Any = None) -> Any:
        return self if instance is None else eqx.Partial(self, instance)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        folder = os.environ.get(PROGRAMS)
        arrays, static = eqx.partition((args, kwargs), eqx.is_array)
        leaves, tree = jax.tree.flatten(arrays)
        if folder is None or not all(map(_is_plain, leaves)) or not _is_plain_context():
            return self._jitted(*args, **kwargs)
        kinds = tuple((leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)) for leaf in leaves)
        values, structure = jax.tree.flatten(static)
        key = (folder, _settings(), kinds, tree, structure, tuple((type(value), value) for value in values))
        if key not in self._executables:
            self._executables[key] = self._executable(Path(folder), static, tree, leaves, kinds)
        executable = self._executables[key]
        if executable is None:
            return self._jitted(*args, **kwargs)
        outputs = executable.call(leaves)
        return jax.tree.map(lambda x: outputs[x.index] if isinstance(x, _Slot) else x, executable.result)

    def _executable(self, folder: Path, static: Any, tree: Any, leaves: list, kinds: tuple) -> _Executable | None:
        """The program for these arguments, read or else compiled; None if code of others is part of it."""
        function = self._function.__module__, self._function.__qualname__
        try:
            description = _pickled(
                (function, static, tree, [str(kind) for kind in kinds], _settings(), _machine(), _source())
            )
        except _ForeignCodeError:
            return None
        entry = folder / hashlib.sha256(description).hexdigest()
        kept = _read(entry)
        if kept is not None:
            name, result, num_outputs = pickle.loads(kept)
            if (payload := _read(folder / name)) is not None:
                return _Executable(_loaded(payload, leaves, num_outputs), result)
        return self._compiled(entry, static, tree, leaves)

    def _compiled(self, entry: Path, static: Any, tree: Any, leaves: list) -> _Executable:
        """The program for these arguments, traced anew; compiled and written unless it is there by another name."""
        result = None

        def of_arrays(leaves: list) -> list:
            nonlocal result
            args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
            arrays, rest = eqx.partition(self._function(*args, **kwargs), eqx.is_array)
            outputs, structure = jax.tree.flatten(arrays)
            result = eqx.combine(jax.tree.unflatten(structure, map(_Slot, range(len(outputs)))), rest)
            return outputs

        of_arrays.__name__ = of_arrays.__qualname__ = self._function.__name__
        lowered = jax.jit(of_arrays).lower(leaves)
        code = lowered.as_text()
        # A call back to Python holds an address of this process.
        if "callback" in code:
            return _Executable(lowered.compile(), result)
        # Another program may be the same one: after an edit of the package, or where the arguments differ in name only.
        name = hashlib.sha256(repr((_without_names(code), _settings(), _machine())).encode()).hexdigest()
        num_outputs = len(jax.tree.leaves(lowered.out_info))
        payload = _read(entry.parent / name)
        call: Callable[[list], list]
        if payload is not None:
            call = _loaded(payload, leaves, num_outputs)
        else:
            call = compiled = _without_cache(lowered)
            try:
                payload, _, _ = serialize_executable.serialize(compiled)
            except (ValueError, NotImplementedError):
                # JAX cannot do this for every program, such as one with large constants in its later versions.
                return _Executable(call, result)
            _write(entry.parent / name, payload)
        _write(entry, pickle.dumps((name, result, num_outputs)))
        return _Executable(call, result)


def program(function: Callable[..., Any]) -> Any:
    """`eqx.filter_jit(function)` for a function of this package.

    After `keep_compiled` its programs are kept on disk. Kept programs are for arguments that are arrays on the first
    device, objects of this package, JAX, NumPy or Equinox, and plain values. Others (an own utility, or transformation
    by `grad` or `vmap`) are jitted as usual.
    """
    return _Program(function)


def _is_plain(leaf: Any) -> bool:
    """Whether an array is in memory, or whole on the first device."""
    if isinstance(leaf, jax.core.Tracer):
        return False
    return not isinstance(leaf, jax.Array) or leaf.sharding.device_set == {jax.local_devices()[0]}


def _is_plain_context() -> bool:
    """Whether programs run on one device, and JAX's debugging, which looks into functions, is off."""
    config: Any = jax.config
    debugs = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs
    return not debugs and config.jax_default_device is None and get_abstract_mesh().empty


def _settings() -> tuple:
    """JAX's settings, those of a context manager included, but where it keeps its cache."""
    names = [name for name in jax.config.values if "cache" not in name]
    return tuple([str(getattr(jax.config, name, jax.config.values[name])) for name in names])


@functools.cache
def _source() -> str:
    """Digest of the package's code."""
    digest, root = hashlib.sha256(), Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _machine() -> str:
    """The libraries and the processor that programs are compiled by and for."""
    versions = [importlib.metadata.version(name) for name in _LIBRARIES]
    device, cpu = jax.local_devices()[0], Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    flags = [line for line in lines if line.startswith(("flags", "Features"))][:1]
    facts = versions, device.platform, device.device_kind, device.client.platform_version, os.environ.get("XLA_FLAGS")
    return repr((*facts, platform.machine(), platform.processor(), flags))


class _ForeignCodeError(Exception):
    """An argument's code is not the package's, so that a kept program could be older than the code."""


class _Pickler(pickle.Pickler):
    """Refuses classes and functions of others."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | types.FunctionType | types.BuiltinFunctionType):
            module = (obj.__module__ or "builtins").partition(".")[0]
            if module not in ("jaxnbv", *_LIBRARIES, *_STANDARD):
                raise _ForeignCodeError(f"{obj.__module__}.{obj.__qualname__}")
        return NotImplemented


def _pickled(x: Any) -> bytes:
    """The same bytes for equal arguments.

    **Raises:** `_ForeignCodeError` for what cannot be pickled, too.
    """
    file = io.BytesIO()
    pickler = _Pickler(file)
    # Without a memo, in which two equal objects and one object twice differ.
    pickler.fast = True
    try:
        pickler.dump(x)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise _ForeignCodeError(str(error)) from error
    return file.getvalue()


def _without_names(code: str) -> str:
    """Lowered code with its functions numbered in order: JAX names them by what this process lowered before."""
    numbers: dict[str, int] = {}

    def number(match: re.Match[str]) -> str:
        return match[0] if match[1] else f"@{numbers.setdefault(match[2], len(numbers))}"

    return re.sub(r"(custom_call )?@(\w+)", number, code)


def _without_cache(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compiled anew: what JAX's cache gives on a CPU cannot be written again whole."""
    with _compiling:
        before = jax.config.values["jax_enable_compilation_cache"]
        jax.config.update("jax_enable_compilation_cache", False)
        compilation_cache.reset_cache()
        try:
            return lowered.compile()
        finally:
            jax.config.update("jax_enable_compilation_cache", before)
            compilation_cache.reset_cache()


def _loaded(payload: bytes, leaves: list, num_outputs: int) -> Callable[[list], list]:
    start = time.monotonic()
    _initialise_lapack()
    inputs, outputs = jax.tree.structure(((leaves,), {})), jax.tree.structure([0] * num_outputs)
    device = jax.local_devices()[0]
    call = serialize_executable.deserialize_and_load(
        payload, inputs, outputs, backend=device.client, execution_devices=[device]
    )
    jax.monitoring.record_event_duration_secs(LOADED, time.monotonic() - start)
    return call


@functools.cache
def _initialise_lapack() -> None:
    """JAX looks LAPACK up when it first lowers a call to it. A loaded program that calls it before would crash."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def _read(path: Path) -> bytes | None:
    """The bytes that `_write` was given. None if the file is missing or damaged."""
    if not path.exists():
        return None
    data = path.read_bytes()
    digest, packed = data[:32], data[32:]
    return zlib.decompress(packed) if hashlib.sha256(packed).digest() == digest else None


def _write(path: Path, data: bytes) -> None:
    """Write a file at once, so that other processes never read half of it."""
    packed = zlib.compress(data, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    part.write_bytes(hashlib.sha256(packed).digest() + packed)
    part.replace(path)
