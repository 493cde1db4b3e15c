"""Folders of results. All results in a folder have one configuration. One process at a time writes to a folder."""

import importlib.metadata
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import filelock
import jax
import numpy as np

from jaxnbv.checks import InputError, require, short_text
from jaxnbv.scanning.triangle_rays import tracer
from jaxnbv.storage.files import PARTS, make_folder, write_text, write_whole

_LOCK = ".lock"
# Name of the file with the large arrays of the configuration.
ARRAYS = "arrays.npz"
# Largest size of a file of arrays after unpacking, in bytes. Sixteen million rays fit, far more than a camera has.
MAX_ARRAY_BYTES = 2**29


def software() -> dict[str, str]:
    """Return the versions of the packages on which results depend, keyed by package name."""
    names = ("jaxnbv", "jax", "jaxlib", "equinox", "optax", "optimistix", "numpy", "trimesh", tracer())
    return {name: importlib.metadata.version(name) for name in names}


def num_threads() -> int:
    """Return the number of CPU threads that XLA uses for a sum: NPROC, or the cores of this process."""
    if threads := os.environ.get("NPROC"):
        return int(threads)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions() -> dict[str, Any]:
    """Return package versions, device and number of threads, on which the last bits of results depend."""
    return software() | {"device": jax.devices()[0].device_kind, "cores": num_threads()}


def differences(stored: Any, current: Any, name: str = "") -> list[str]:
    """Return a text, which begins with the entry's path, for each entry in which two descriptions differ.

    - `name`: path of the two descriptions, with which the paths of their entries begin.
    """
    if isinstance(stored, dict) and isinstance(current, dict):
        keys = list(dict.fromkeys([*stored, *current]))
        nested = (differences(stored.get(key), current.get(key), f"{name}.{key}".lstrip(".")) for key in keys)
        return [difference for group in nested for difference in group]
    return [] if stored == current else [f"{name}: {short_text(stored)} there, {short_text(current)} now"]


def check_format(format: Any, supported: int, file: Path) -> None:
    """Check the format of a file. **Raises:** `ValueError` if `format` is not `supported`."""
    require(
        format == supported,
        f"{file} is of format {str(format)[:20]}; this version of jaxnbv reads format {supported}: install a newer "
        "one, or choose another folder",
    )


def read_json(file: Path, problem: str, remedy: str) -> dict[str, Any]:
    """Read a JSON file that holds an object (a dictionary).

    **Raises:** `ValueError` with the texts `problem` and `remedy`, if the file cannot be read or holds no JSON object.
    """
    # Check this first, because reading from something that is not a file, such as a pipe, may never end.
    require(os.path.isfile(file) or not os.path.lexists(file), f"{file} {problem} (it is no file): {remedy}")
    try:
        content = json.loads(file.read_bytes())
    except (ValueError, OSError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{file} {problem} ({reason}): {remedy}") from error
    require(isinstance(content, dict), f"{file} {problem} (it holds a {type(content).__name__}): {remedy}")
    return content


def write_arrays(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays, keyed by name, to a compressed .npz file as `write_whole` does.

    **Raises:** `ValueError` if the arrays are larger than `read_arrays` accepts, and whenever `write_whole` raises it.
    """
    size = sum(array.nbytes for array in arrays.values())
    require(size <= MAX_ARRAY_BYTES, f"cannot write {file}: its arrays have {size} bytes, more than {MAX_ARRAY_BYTES}")
    write_whole(file, lambda stream: np.savez_compressed(stream, **arrays))  # type: ignore[arg-type]


def read_arrays(file: Path, remedy: str, check: Callable[[dict[str, np.ndarray]], None]) -> dict[str, np.ndarray]:
    """Read the arrays of a .npz file, keyed by name.

    - `check`: a function that raises any error if the arrays differ from the written arrays.

    **Raises:** `ValueError` with the text `remedy` if the file is missing or damaged.
    """
    try:
        if not file.is_file():
            raise ValueError("there is no file")
        with np.load(file, allow_pickle=False) as archive:
            size = sum(member.file_size for member in archive.zip.infolist())
            # The headers of the file may take another 2^20 bytes.
            if size > MAX_ARRAY_BYTES + 2**20:
                raise ValueError(f"it unpacks to {size} bytes")
            arrays = {key: archive[key] for key in archive.files}
        check(arrays)
        return arrays
    # If bits of the file are flipped, NumPy and zipfile raise some twenty kinds of errors.
    except Exception as error:
        raise InputError(f"{file} is damaged ({error}): {remedy}") from error


def read_record(folder: Path, kind: str, remedy: str) -> dict[str, Any]:
    """Read the record of a folder, a dictionary with the key "config", from the file `kind`.json.

    **Raises:** `ValueError` with the text `remedy` if there is no record, or if the record has no configuration.
    """
    file, problem = folder / f"{kind}.json", f"is no {kind} record"
    record = read_json(file, problem, remedy)
    require(isinstance(record.get("config"), dict), f"{file} {problem} (it has no config): {remedy}")
    return record


@contextmanager
def writing_in(path: Path) -> Iterator[None]:
    """Context manager: lock a folder for writing, and remove partial files of killed processes.

    **Raises:** `ValueError` if another process writes there, or the folder cannot be written.
    """
    lock = filelock.FileLock(path / _LOCK, timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise InputError(
            f"{path} is being written by another process: wait until it ends, or choose another folder"
        ) from error
    # filelock (3.16 and later) raises these errors if the file system has no locks.
    except (OSError, NotImplementedError) as error:
        raise InputError(f"cannot write in {path} ({error}): make room or choose another place") from error
    try:
        for partial in path.glob(PARTS):
            partial.unlink()
        yield
    finally:
        lock.release()


class ResultFolder:
    """A folder of results that all have one configuration, and the record of the configuration.

    - `config`: the configuration as JSON, see `jaxnbv.storage.describe`.
    - `arrays`: contents of the configuration's large arrays, keyed by hash. They are stored in arrays.npz.

    The record is the file `kind`.json, which is written before the first result. Subclasses define:

    - `kind`: kind of results, such as "study".
    - `pattern`: pattern of the names of result files.
    - `format`: version number of the file format.
    - `is_shared`: whether a folder without a record may hold other files.

    **Raises:** `ValueError` if the folder cannot be created, holds results of a different configuration, or has no
    record but other files (unless `is_shared`).
    """

    kind: str
    pattern: str
    format: int
    is_shared: bool = False

    def __init__(
        self, path: str | Path, config: dict[str, Any], arrays: Mapping[str, np.ndarray] = MappingProxyType({})
    ):
        self.path, self.config = make_folder(path), json.loads(json.dumps(config))
        self.arrays = dict(arrays)
        self.versions: dict[str, Any] = {}
        self.is_bound = False
        self._check()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Context manager: lock the folder for writing results, as `writing_in` does."""
        with writing_in(self.path):
            # Another process may have written since the last check.
            self._check()
            yield

    def set_versions(self, versions: dict[str, Any]) -> None:
        """Set the versions with which new results are computed. Warns if they differ from the record."""
        self.versions = versions
        if not self.is_bound:
            return
        record = read_record(self.path, self.kind, "choose another output folder")
        if changes := differences(record.get("versions"), versions):
            warnings.warn(
                f"{self.path} was begun with other versions ({'; '.join(changes)}): new results may differ in their "
                "last bits from those of an uninterrupted run",
                stacklevel=3,
            )

    def bind(self) -> None:
        """Write the record and its arrays, if they are not there yet. Called before the first result."""
        if not self.is_bound:
            record = {"format": self.format, "config": self.config, "versions": self.versions}
            # Write the record first, because arrays without a record would belong to no configuration.
            write_text(self.path / f"{self.kind}.json", json.dumps(record, indent=2))
            if self.arrays:
                write_arrays(self.path / ARRAYS, self.arrays)
            self.is_bound = True

    def _check(self) -> None:
        file = self.path / f"{self.kind}.json"
        if not file.exists():
            names = sorted(entry.name for entry in self.path.iterdir())
            others = [name for name in names if name != _LOCK and not name.endswith(".partial")]
            require(
                not others or self.is_shared,
                f"the output folder {self.path} holds other files ({', '.join(others[:3])}): choose an empty folder",
            )
            return
        record = read_record(self.path, self.kind, "choose another output folder")
        check_format(record.get("format"), self.format, file)
        # If there is a record but no result, the run ended before its first result, and the record may be overwritten.
        if not any(self.path.glob(self.pattern)):
            return
        changes = differences(record["config"], self.config)
        require(
            not changes,
            f"the output folder {self.path} belongs to another {self.kind}; it differs in {'; '.join(changes[:3])}. "
            "Choose another folder, or remove this one",
        )
        self.is_bound = True
