"""Compiled programs that later processes load without tracing them again.

JAX's own cache saves only the compilation. A later process must still trace and lower each function to find its cache
entry, which takes longer than all other work of the process. A `program` finds its entry from the arguments alone.
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
import warnings
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

# Arguments of a stored program may contain code of this package and of these modules. The versions of the libraries are
# part of the key.
_LIBRARIES = ("jax", "jaxlib", "numpy", "equinox", "optimistix", "lineax", "optax")
_STANDARD = ("builtins", "collections", "copyreg", "functools", "math", "operator", "pathlib")
# Name of the event that is reported to `jax.monitoring` after a program was loaded.
LOADED = "/jaxnbv/program_load_duration"
_compile_lock = threading.Lock()


@dataclasses.dataclass(frozen=True)
class _ArrayPlaceholder:
    """Placeholder for an array in a program's result. `index` is its place among the output arrays."""

    index: int


class _Executable(NamedTuple):
    """A program that is compiled for arguments with certain shapes, types and static values.

    - `call`: function from the arguments' arrays to the output arrays.
    - `result`: the result with an `_ArrayPlaceholder` in place of each array.
    """

    call: Callable[[list], list]
    result: Any


class _Program:
    """A function that `eqx.filter_jit` compiles. After `keep_compiled`, its programs are stored on disk."""

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
            self._executables[key] = self._load_or_compile(Path(folder), static, tree, leaves, kinds)
        executable = self._executables[key]
        if executable is None:
            return self._jitted(*args, **kwargs)
        outputs = executable.call(leaves)
        return jax.tree.map(lambda x: outputs[x.index] if isinstance(x, _ArrayPlaceholder) else x, executable.result)

    def _load_or_compile(self, folder: Path, static: Any, tree: Any, leaves: list, kinds: tuple) -> _Executable | None:
        """Load or compile the program; return None if the arguments contain code that is not permitted.

        - `static`: the arguments without their arrays.
        - `tree`, `leaves`, `kinds`: structure of the tree of arrays, the arrays, and their shapes and types.
        """
        function = self._function.__module__, self._function.__qualname__
        try:
            description = _pickle(
                (function, static, tree, [str(kind) for kind in kinds], _settings(), _machine(), _source())
            )
        except _ForeignCodeError:
            return None
        entry = folder / hashlib.sha256(description).hexdigest()
        entry_data = _read(entry)
        if entry_data is not None:
            name, result, num_outputs = pickle.loads(entry_data)
            if (payload := _read(folder / name)) is not None:
                return _Executable(_load(payload, leaves, num_outputs), result)
        return self._compile(entry, static, tree, leaves)

    def _compile(self, entry: Path, static: Any, tree: Any, leaves: list) -> _Executable:
        """Trace and lower the function. Load the program stored for the lowered code, or else compile it.

        - `entry`: path of the file for these arguments. It stores the name of the program's file.
        """
        result = None

        def array_function(leaves: list) -> list:
            nonlocal result
            args, kwargs = eqx.combine(jax.tree.unflatten(tree, leaves), static)
            arrays, rest = eqx.partition(self._function(*args, **kwargs), eqx.is_array)
            outputs, structure = jax.tree.flatten(arrays)
            result = eqx.combine(jax.tree.unflatten(structure, map(_ArrayPlaceholder, range(len(outputs)))), rest)
            return outputs

        array_function.__name__ = array_function.__qualname__ = self._function.__name__
        # Keep unused arguments in the code. Otherwise programs of different arguments could have the same code.
        lowered = jax.jit(array_function, keep_unused=True).lower(leaves)
        code = lowered.as_text()
        # A program with a callback to Python cannot be stored, because it contains an address of this process.
        if "callback" in code:
            return _Executable(lowered.compile(), result)
        # The same code may be stored for another entry, because an unrelated part of the package was edited, or because
        # the static arguments differ only in something that the code does not use, such as a name.
        name = hashlib.sha256(repr((_without_names(code), _settings(), _machine())).encode()).hexdigest()
        num_outputs = len(jax.tree.leaves(lowered.out_info))
        payload = _read(entry.parent / name)
        call: Callable[[list], list]
        if payload is not None:
            call = _load(payload, leaves, num_outputs)
        else:
            call = compiled = _compile_uncached(lowered)
            try:
                payload, _, _ = serialize_executable.serialize(compiled)
            except (ValueError, NotImplementedError):
                # JAX cannot serialize every program. Later versions refuse programs with large constants.
                return _Executable(call, result)
            _write(entry.parent / name, payload)
        _write(entry, pickle.dumps((name, result, num_outputs)))
        return _Executable(call, result)


def program(function: Callable[..., Any]) -> Any:
    """Decorator: `eqx.filter_jit` for a function of this package, with compiled programs stored on disk.

    Programs are stored after `keep_compiled` was called, for arguments that are arrays on the first device, objects of
    this package, JAX, NumPy or Equinox, and plain values. Other calls are jitted as usual, for example with a user's
    own utility, or under `grad` or `vmap`.
    """
    return _Program(function)


def _is_plain(leaf: Any) -> bool:
    """Return whether an array is concrete, and either a NumPy array or entirely on the first device."""
    if isinstance(leaf, jax.core.Tracer):
        return False
    return not isinstance(leaf, jax.Array) or leaf.sharding.device_set == {jax.local_devices()[0]}


def _is_plain_context() -> bool:
    """Return whether programs run on the first device only, and JAX's debugging options are off."""
    config: Any = jax.config
    debugs = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs
    return not debugs and config.jax_default_device is None and get_abstract_mesh().empty


def _settings() -> tuple:
    """Return JAX's settings (also those of context managers), without settings that change no program.

    `own_settings` allows all transfers, so a program may run with and without a transfer guard.
    """
    names = [name for name in jax.config.values if "cache" not in name and "transfer_guard" not in name]
    return tuple([str(getattr(jax.config, name, jax.config.values[name])) for name in names])


@functools.cache
def _source() -> str:
    """Return a digest of the package's code."""
    digest, root = hashlib.sha256(), Path(__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def _machine() -> str:
    """Return a text that identifies the versions of the libraries, the first device and the processor."""
    versions = [importlib.metadata.version(name) for name in _LIBRARIES]
    device, cpu = jax.local_devices()[0], Path("/proc/cpuinfo")
    lines = cpu.read_text().splitlines() if cpu.exists() else []
    flags = [line for line in lines if line.startswith(("flags", "Features"))][:1]
    facts = versions, device.platform, device.device_kind, device.client.platform_version, os.environ.get("XLA_FLAGS")
    return repr((*facts, platform.machine(), platform.processor(), flags))


class _ForeignCodeError(Exception):
    """An argument contains code of a module that is not permitted, so the program is not stored.

    Changes of this code would not change the key that finds the program.
    """


class _Pickler(pickle.Pickler):
    """A pickler that refuses classes and functions of modules that are not permitted."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type | types.FunctionType | types.BuiltinFunctionType):
            module = (obj.__module__ or "builtins").partition(".")[0]
            if module not in ("jaxnbv", *_LIBRARIES, *_STANDARD):
                raise _ForeignCodeError(f"{obj.__module__}.{obj.__qualname__}")
        return NotImplemented


def _pickle(x: Any) -> bytes:
    """Pickle an object so that equal objects give equal bytes. **Raises:** `_ForeignCodeError`."""
    file = io.BytesIO()
    pickler = _Pickler(file)
    # Turn off the memo. With it, two equal objects would give other bytes than the same object twice.
    pickler.fast = True
    try:
        pickler.dump(x)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise _ForeignCodeError(str(error)) from error
    return file.getvalue()


def _without_names(code: str) -> str:
    """Replace functions' names in lowered code by numbers. The names depend on what was lowered before."""
    numbers: dict[str, int] = {}

    def number(match: re.Match[str]) -> str:
        return match[0] if match[1] else f"@{numbers.setdefault(match[2], len(numbers))}"

    return re.sub(r"(custom_call )?@(\w+)", number, code)


def _compile_uncached(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compile without JAX's cache. On a CPU, a program from this cache cannot be serialized completely."""
    with _compile_lock:
        was_enabled = jax.config.values["jax_enable_compilation_cache"]
        jax.config.update("jax_enable_compilation_cache", False)
        compilation_cache.reset_cache()
        try:
            return lowered.compile()
        finally:
            jax.config.update("jax_enable_compilation_cache", was_enabled)
            compilation_cache.reset_cache()


def _load(payload: bytes, leaves: list, num_outputs: int) -> Callable[[list], list]:
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
    """Lower a call to LAPACK, so that JAX initialises its LAPACK functions.

    JAX initialises them when it first lowers such a call. A loaded program that calls LAPACK earlier would crash.
    """
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def _read(path: Path) -> bytes | None:
    """Return the bytes that `_write` stored; None if the file is missing or damaged."""
    if not path.exists():
        return None
    data = path.read_bytes()
    digest, packed = data[:32], data[32:]
    return zlib.decompress(packed) if hashlib.sha256(packed).digest() == digest else None


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically, so that other processes never read a part of it. Warn if this fails."""
    packed = zlib.compress(data, 1)
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(hashlib.sha256(packed).digest() + packed)
        part.replace(path)
    except OSError as error:
        warnings.warn(
            f"a compiled program cannot be kept in {path.parent} ({error}): the next process compiles it again, unless "
            "you make room there or give keep_compiled another folder",
            stacklevel=2,
        )
