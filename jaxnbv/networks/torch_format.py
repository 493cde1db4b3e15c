"""The tensors of a PyTorch file, read without PyTorch and without running anything that the file asks for.

A `.pth` file is a pickle, that is, a program, beside the raw bytes of its arrays. Here the program may build
dictionaries, numbers, strings and tensors; every other name in it is refused. Two layouts are read: the zip archive
written since PyTorch 1.6 (`data.pkl`, `data/0`, `data/1`, ...), and the older stream of pickles followed by the arrays.
"""

import math
import mmap
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.networks.pickled import Function, Mutable, dictionary, unpickle

_STORAGES = {
    "DoubleStorage": np.dtype("f8"),
    "FloatStorage": np.dtype("f4"),
    "HalfStorage": np.dtype("f2"),
    "BFloat16Storage": np.dtype(jnp.bfloat16),
    "LongStorage": np.dtype("i8"),
    "IntStorage": np.dtype("i4"),
    "ShortStorage": np.dtype("i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
_STREAM_MAGIC = 0x1950A86A20F9469CFC6C
_STREAM_PROTOCOL = 1001
_BYTE_ORDERS = ("<", ">", "=", "|")
# NumPy's own limit.
_MOST_DIMENSIONS = 64
_LONGEST_PROBLEM = 500
_STATE_NAMES = ("model_state_dict", "state_dict")


def read_torch_tensors(path: str | Path) -> dict[str, np.ndarray]:
    """The model's tensors by name, read-only, from a file made by `torch.save`.

    The file holds a state dictionary, or a training checkpoint with one under `model_state_dict` or `state_dict`. The
    prefix `module.` of models trained on several devices is dropped.

    **Raises:** `ValueError` for a file that is missing, damaged, not PyTorch's, without a state dictionary, or that
    asks for anything but tensors and plain values.
    """
    path = Path(path)
    require(os.path.isfile(path), f"there is no file {path}: give the path of a PyTorch checkpoint")
    try:
        with path.open("rb") as file:
            archive = file.read(2) == b"PK"
            content = _read_archive(file, path.stat().st_size) if archive else _read_stream(file)
        tensors = _state_dictionary(content)
    except InputError as error:
        # Names in a file are as long as it pleases.
        raise InputError(f"{path}: {str(error)[:_LONGEST_PROBLEM]}") from error
    except Exception as error:  # a damaged pickle can raise nearly anything
        problem = f"{type(error).__name__}: {error}"[:_LONGEST_PROBLEM]
        raise InputError(f"{path} is damaged or no PyTorch checkpoint ({problem}): fetch or save it again") from error
    return tensors


def _state_dictionary(content: Any) -> dict[str, np.ndarray]:
    if isinstance(content, dict):
        content = next((content[name] for name in _STATE_NAMES if name in content), content)
    require(
        isinstance(content, dict) and len(content) > 0 and all(isinstance(name, str) for name in content),
        "holds no state dictionary; save model.state_dict(), or a dictionary with it under 'model_state_dict'",
    )
    odd = [name for name, tensor in content.items() if not isinstance(tensor, np.ndarray)]
    require(not odd, f"entry {odd[:1]} is not a tensor; save model.state_dict() alone, or under 'model_state_dict'")
    shared = "module." if all(name.startswith("module.") for name in content) else ""
    return {name.removeprefix(shared): tensor for name, tensor in content.items()}


def _read_archive(file: IO[bytes], length: int) -> Any:
    """The zip archive: one folder that holds data.pkl, the arrays as data/<key>, and the byte order."""
    file.seek(0)
    with zipfile.ZipFile(file) as archive:
        names = set(archive.namelist())
        left = length

        def read(name: str) -> bytes:
            """A member as it lies in the file, so that all together are no longer than it."""
            nonlocal left
            require(name in names, f"the storage {name} is missing: fetch or save the file again")
            member = archive.getinfo(name)
            left -= member.file_size
            require(
                member.compress_type == zipfile.ZIP_STORED and left >= 0,
                f"the member {name} is compressed or longer than the file, which torch.save never makes",
            )
            return archive.read(member)

        roots = [name.removesuffix("data.pkl") for name in names if name.endswith("/data.pkl") and name.count("/") == 1]
        require(len(roots) == 1, "is a zip file, but not one made by torch.save: it has no data.pkl")
        root = roots[0]
        order = read(f"{root}byteorder").decode().strip() if f"{root}byteorder" in names else "little"
        require(
            order in ("little", "big"), f"the byte order is '{order[:20]}', neither little nor big: the file is damaged"
        )

        def load(key: str, dtype: np.dtype, count: int) -> np.ndarray:
            name = f"{root}data/{key}"
            data = read(name)
            size = len(data)
            require(
                size == count * dtype.itemsize,
                f"the storage {name} has {size} bytes instead of {count} x {dtype.itemsize}: fetch the file again",
            )
            bits = np.frombuffer(data, f"{'>' if order == 'big' else '<'}u{dtype.itemsize}")
            return bits.astype(bits.dtype.newbyteorder("="), copy=False).view(dtype)

        program = read(f"{root}data.pkl")
        return _unpickle(program, len(program), load)


def _read_stream(opened: IO[bytes]) -> Any:
    """The layout before PyTorch 1.6: magic number, protocol, system, content, keys; then each array's count and bytes.

    The arrays come last, so the tensors are made as views of arrays that are filled afterwards.
    """
    # Of a map a read is never longer than what is there.
    file = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ)
    left = len(file)

    def load_none(key: str, dtype: np.dtype, count: int) -> np.ndarray:
        raise InputError("tensors stand before the content: the file is damaged")

    def plain() -> Any:
        return _unpickle(file, len(file), load_none)

    try:
        magic = plain()
    except InputError:
        raise
    except Exception:  # whatever a file that is not a pickle at all may raise
        magic = None
    require(
        type(magic) is int and magic == _STREAM_MAGIC,
        "is neither a zip archive nor an older PyTorch file: fetch it again, or torch.save the model anew",
    )
    protocol, system = plain(), plain()
    require(
        protocol == _STREAM_PROTOCOL and isinstance(system, dict) and system.get("little_endian") is True,
        "is an older PyTorch file of an unknown kind: load it with PyTorch and torch.save it again",
    )
    storages: dict[str, np.ndarray] = {}

    def load(key: str, dtype: np.dtype, count: int) -> np.ndarray:
        nonlocal left
        if key not in storages:
            left -= count * dtype.itemsize
            require(left >= 0, f"the storage {key} is larger than the file: fetch it again")
            storages[key] = np.zeros(count, dtype)
        require(storages[key].shape == (count,), f"the storage {key} has two sizes: the file is damaged")
        return storages[key]

    content, keys = _unpickle(file, len(file), load), plain()
    require(isinstance(keys, list) and all(isinstance(key, str) for key in keys), "the list of storages is damaged")
    same = len(keys) == len(storages) and {*keys} == storages.keys()
    require(same, f"lists {len(keys)} storages where its tensors need {len(storages)} others: the file is damaged")
    for key in keys:
        storage = storages[key]
        (count,) = struct.unpack("<q", file.read(8))
        data = file.read(storage.nbytes)
        require(
            count == len(storage) and len(data) == storage.nbytes,
            f"the storage {key} is cut short or of another size: fetch the file again",
        )
        storage.view("u1")[:] = np.frombuffer(data, "u1")
    return content


class _NumpyType(Mutable):
    """A `numpy.dtype` of plain numbers as a pickle describes it: a name, then its byte order."""

    def __init__(self, name: Any, *_: Any):
        require(isinstance(name, str), "describes a NumPy type by something other than its name: the file is damaged")
        self.dtype = np.dtype(name)
        require(self.dtype.kind in "fiub", f"refused: the file holds NumPy objects of type {name}")

    def set_state(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        require(order in _BYTE_ORDERS, "a NumPy type has no byte order: the file is damaged")
        self.dtype = self.dtype.newbyteorder(order)


class _Storage(NamedTuple):
    dtype: np.dtype


_Load = Callable[[str, np.dtype, int], np.ndarray]


def _unpickle(file: Any, length: int, load: _Load) -> Any:
    """The next pickle of a file of so many bytes, whose storages `load` gives by key, type and count."""

    def persistent(identifier: Any) -> np.ndarray:
        """The storage that ('storage', type, key, device, count) names; older files add a view, always None here."""
        parts = identifier if isinstance(identifier, tuple) and len(identifier) in (5, 6) else (None,) * 5
        kind, storage, key, _, count, *view = parts
        proper = kind == "storage" and isinstance(storage, _Storage) and isinstance(key, str | int)
        require(
            proper and _is_size(count) and view in ([], [None]),
            "refers to something other than a storage: the file is damaged",
        )
        return load(str(key), storage.dtype, count)

    return unpickle(file, length, _name, persistent)


def _name(module: str, name: str) -> Any:
    """What stands for a name; every other name is refused, unimported."""
    if module in ("torch", "torch.cuda") and name in _STORAGES:
        return _Storage(_STORAGES[name])
    require(
        (module, name) in _FUNCTIONS,
        f"refused: the file asks to run {module}.{name}, and only tensors and plain values are read. Load it with "
        "PyTorch where you trust it, and torch.save the model's state_dict() again",
    )
    return Function(_FUNCTIONS[module, name])


def _is_size(number: Any) -> bool:
    return type(number) is int and 0 <= number < 2**63


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> np.ndarray:
    require(
        isinstance(storage, np.ndarray)
        and isinstance(shape, tuple)
        and isinstance(strides, tuple)
        and all(map(_is_size, (offset, *shape, *strides)))
        and len(shape) == len(strides) <= _MOST_DIMENSIONS,
        "a tensor has no proper storage, shape or strides: the file is damaged",
    )
    size = math.prod(shape)
    end = offset + 1 + sum((length - 1) * stride for length, stride in zip(shape, strides, strict=True))
    require(
        size == 0 or (end <= storage.size and size <= storage.size),
        f"a tensor of shape {shape}, strides {strides}, offset {offset} does not fit its storage of {storage.size}",
    )
    if size == 0:
        return np.zeros(shape, storage.dtype)
    steps = tuple(stride * storage.itemsize for stride in strides)
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False)


def _bytes(text: Any, encoding: Any) -> bytes:
    require(isinstance(text, str) and encoding == "latin1", "refused: the file asks for another encoding than latin1")
    return text.encode("latin1")


def _numpy_scalar(kind: Any, raw: Any) -> Any:
    require(isinstance(kind, _NumpyType) and isinstance(raw, bytes), "a NumPy number has no type: the file is damaged")
    return np.frombuffer(raw, kind.dtype, count=1)[0]


_FUNCTIONS: dict[tuple[str, str], Callable[..., Any]] = {
    ("collections", "OrderedDict"): dictionary,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
    ("_codecs", "encode"): _bytes,
    ("numpy", "dtype"): _NumpyType,
    ("numpy.core.multiarray", "scalar"): _numpy_scalar,
    ("numpy._core.multiarray", "scalar"): _numpy_scalar,
}
