"""Reads the tensors of a PyTorch file, without PyTorch and without running code from the file.

A `.pth` file holds a pickle, which is a program, and the raw bytes of the arrays. This reader imports nothing. It knows
only the names that a pickle needs for tensors and dictionaries, and replaces any other name by an object that does
nothing. Two layouts are supported: the zip archive since PyTorch 1.6 (`data.pkl`, `data/0`, `data/1`, ...), and the
older stream of pickles followed by the arrays.
"""

import functools
import mmap
import os
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from io import BufferedIOBase, BytesIO
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.networks.pickle_bounds import skip_pickle

# Values are names of types, because a pickle could modify a type, but cannot modify a string.
_TYPES = {
    "DoubleStorage": "float64",
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "BFloat16Storage": jnp.bfloat16.dtype.name,
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
}
_STREAM_MAGIC = 0x1950A86A20F9469CFC6C
_STATE_NAMES = ("model_state_dict", "state_dict")
# Function that loads a storage (the numbers of a tensor), given its key, type and number of entries.
_Load = Callable[[str, str, int], np.ndarray]


def read_torch_tensors(path: str | Path) -> dict[str, np.ndarray]:
    """Read the tensors of a model, keyed by name, from a file that `torch.save` wrote.

    The file holds a state dictionary, or a training checkpoint with a state dictionary under `model_state_dict` or
    `state_dict`. If all names begin with `module.`, as after training on several devices, this prefix is removed.

    **Raises:** `ValueError` if the file is missing, damaged, not from PyTorch, or has no state dictionary.
    """
    path = Path(path)
    require(os.path.isfile(path), f"there is no file {path}: give the path of a PyTorch checkpoint")
    try:
        with path.open("rb") as file:
            is_archive = file.read(2) == b"PK"
            file.seek(0)
            size = os.fstat(file.fileno()).st_size
            return _state_dictionary((_read_archive if is_archive else _read_stream)(file, size))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # a damaged pickle can raise nearly anything
        problem = f"{type(error).__name__}: {error}"
        raise InputError(f"{path} is damaged or no PyTorch checkpoint ({problem}): fetch or save it again") from error


def _state_dictionary(content: Any) -> dict[str, np.ndarray]:
    if isinstance(content, dict):
        content = next((content[name] for name in _STATE_NAMES if name in content), content)
    require(
        isinstance(content, dict) and len(content) > 0 and all(isinstance(name, str) for name in content),
        "holds no state dictionary; save model.state_dict(), or a dictionary with it under 'model_state_dict'",
    )
    wrong_names = [name for name, tensor in content.items() if not isinstance(tensor, np.ndarray)]
    require(
        not wrong_names,
        f"entry {wrong_names[:1]} is not a tensor; save model.state_dict() alone, or under 'model_state_dict'",
    )
    prefix = "module." if all(name.startswith("module.") for name in content) else ""
    return {name.removeprefix(prefix): tensor for name, tensor in content.items()}


def _read_archive(file: BufferedIOBase, size: int) -> Any:
    """Read a zip archive: a folder with data.pkl, the arrays as data/<key>, and the byte order."""
    with zipfile.ZipFile(file) as archive:
        unpacked_size = sum(entry.file_size for entry in archive.infolist())
        require(
            unpacked_size <= size,
            f"unpacks to {unpacked_size} bytes from {size}, which torch.save does not: save it again",
        )
        roots = [name.removesuffix("data.pkl") for name in archive.namelist() if name.endswith("/data.pkl")]
        require(len(roots) == 1, "is a zip file, but not one made by torch.save: it has no data.pkl")
        order = f"{roots[0]}byteorder"
        require(
            order not in archive.namelist() or archive.read(order).strip() == b"little",
            "was written by a big-endian machine: load it with PyTorch and torch.save it again",
        )
        contents = functools.cache(lambda key: archive.read(f"{roots[0]}data/{key}"))
        pickled = archive.read(f"{roots[0]}data.pkl")
        return _unpickle(BytesIO(pickled), len(pickled), lambda key, *form: np.frombuffer(contents(key), *form))


def _read_stream(file: BufferedIOBase, size: int) -> Any:
    """Read a stream of pickles, the layout before PyTorch 1.6.

    The file has a magic number, the protocol, the system, the content, the keys, and then the count and the bytes of
    each array. The arrays come last, so the tensors are first made as views of zeros, which are then overwritten.
    """
    storages: dict[str, np.ndarray] = {}

    def load(key: str, kind: str, count: int) -> np.ndarray:
        if key not in storages:
            total = sum(storage.nbytes for storage in storages.values()) + count * np.dtype(kind).itemsize
            require(total <= size, f"declares arrays of {total} bytes, more than it has: fetch the file again")
            storages[key] = np.zeros(count, kind)
        return storages[key]

    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        magic, _, _, content, keys = (_unpickle(mapped, size, load) for _ in range(5))
        file.seek(mapped.tell())
    require(magic == _STREAM_MAGIC, "is neither a zip archive nor an older PyTorch file: torch.save the model anew")
    require(sorted(keys) == sorted(storages), "lists other storages than its tensors need: the file is damaged")
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        num_read = file.readinto(storages[key].view("uint8").data)
        require(
            count == len(storages[key]) and num_read == storages[key].nbytes,
            f"the storage {key} is cut short or of another size: fetch the file again",
        )
    return content


def _unpickle(file: BytesIO | mmap.mmap, size: int, load: _Load) -> Any:
    """Load the object in the next pickle of a file of `size` bytes, with storages from `load`."""
    start = file.tell()
    skip_pickle(file, size)
    end = file.tell()
    file.seek(start)
    return _TensorUnpickler(BytesIO(file.read(end - start)), load).load()


class _TensorUnpickler(pickle.Unpickler):
    """Unpickler that only creates tensors and dictionaries. Everything else becomes a `_Placeholder`."""

    def __init__(self, file: BytesIO, load: _Load):
        super().__init__(file)
        self._storage = load
        self._items = len(file.getbuffer())

    def find_class(self, module: str, name: str) -> Any:
        """Return the object that stands for a global name in the pickle."""
        if module in ("torch", "torch.cuda") and name in _TYPES:
            return _TYPES[name]
        if (module, name) == ("collections", "OrderedDict"):
            return self._dictionary
        return _FUNCTIONS.get((module, name), _Placeholder)

    def persistent_load(self, identifier: Any) -> np.ndarray:
        """Return the storage for an identifier: ('storage', type, key, device, count, None in older files)."""
        _, kind, key, _, count, *_ = identifier
        return self._storage(key, kind, count)

    def _dictionary(self, items: Any = ()) -> "_Dictionary":
        """Return a dictionary of the items.

        All dictionaries of a pickle together may have at most as many items as the pickle has bytes.
        """
        self._items -= len(items)
        require(self._items >= 0, "copies the same dictionary over and over: it is damaged")
        return _Dictionary(items)


class _Dictionary(OrderedDict):
    """A dictionary that ignores the attributes that a pickled state dictionary may have beside its items."""

    def __setstate__(self, _: Any) -> None:
        pass


class _Placeholder:
    """Replacement for a class or function that a pickle names but may not use. It does nothing."""

    def __new__(cls, *_: Any) -> "_Placeholder":
        return super().__new__(cls)

    def __call__(self, *_: Any) -> "_Placeholder":
        return self

    def __setstate__(self, _: Any) -> None:
        pass


def _tensor(storage: np.ndarray, offset: int, shape: tuple[int, ...], strides: tuple[int, ...], *_: Any) -> np.ndarray:
    """Return a view of a storage, or raise an error beyond its end. `offset` and `strides` are in entries."""
    size = storage.itemsize
    tensor = np.ndarray(shape, storage.dtype, storage, offset * size, tuple(stride * size for stride in strides))
    require(tensor.size <= storage.size, f"stretches {storage.size} numbers to a tensor of shape {shape}: save a copy")
    return tensor


_FUNCTIONS: dict[tuple[str, str], Any] = {
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
}
