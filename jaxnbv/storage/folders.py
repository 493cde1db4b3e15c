"""A folder whose results belong to one configuration and are written by one process at a time."""

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

from jaxnbv.checks import InputError, require
from jaxnbv.scanning.triangle_rays import tracer
from jaxnbv.storage.files import PARTS, make_folder, write_text, write_whole

_LOCK = ".lock"
# What belongs to the record, beside it.
ARRAYS = "arrays.npz"
# In bytes, unpacked: sixteen million rays, far more than a camera has.
LARGEST = 2**29
_LONGEST_SHOWN = 60


def software() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    names = ("jaxnbv", "jax", "jaxlib", "equinox", "optax", "optimistix", "numpy", "trimesh", tracer())
    return {name: importlib.metadata.version(name) for name in names}


def num_threads() -> int:
    """Threads among which XLA splits a sum on a CPU: NPROC, or else the cores that this process may use."""
    if threads := os.environ.get("NPROC"):
        return int(threads)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions() -> dict[str, Any]:
    """What the last bits of this process's numbers depend on: software, kind of device, and number of threads."""
    return software() | {"device": jax.devices()[0].device_kind, "cores": num_threads()}


def differences(found: Any, asked: Any, name: str = "") -> list[str]:
    """Where two descriptions differ, in words."""
    if isinstance(found, dict) and isinstance(asked, dict):
        keys = list(dict.fromkeys([*found, *asked]))
        nested = (differences(found.get(key), asked.get(key), f"{name}.{key}".lstrip(".")) for key in keys)
        return [difference for group in nested for difference in group]
    return [] if found == asked else [f"{name}: {_short(found)} there, {_short(asked)} now"]


def _short(value: Any) -> str:
    """The beginning of what may be the source of a function."""
    text = str(value)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def check_format(found: Any, known: int, file: Path) -> None:
    """**Raises:** `ValueError` for a file of a format that is not known here."""
    require(
        found == known,
        f"{file} is of format {str(found)[:20]}; this version of jaxnbv reads format {known}: install a newer one, or "
        "choose another folder",
    )


def read_json(file: Path, problem: str, remedy: str) -> dict[str, Any]:
    """What a JSON file holds.

    **Raises:** `ValueError` that tells `problem` and `remedy`, unless that is an object.
    """
    # What is no file, such as a pipe, may never end.
    require(os.path.isfile(file) or not os.path.lexists(file), f"{file} {problem} (it is no file): {remedy}")
    try:
        content = json.loads(file.read_bytes())
    except (ValueError, OSError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{file} {problem} ({reason}): {remedy}") from error
    require(isinstance(content, dict), f"{file} {problem} (it holds a {type(content).__name__}): {remedy}")
    return content


def write_arrays(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a .npz file, all or nothing.

    **Raises:** `ValueError` as `write_whole` does, or if they are larger than `read_arrays` reads.
    """
    size = sum(array.nbytes for array in arrays.values())
    require(size <= LARGEST, f"cannot write {file}: its arrays have {size} bytes, more than {LARGEST}")
    write_whole(file, lambda opened: np.savez_compressed(opened, **arrays))  # type: ignore[arg-type]


def read_arrays(file: Path, remedy: str, check: Callable[[dict[str, np.ndarray]], None]) -> dict[str, np.ndarray]:
    """The arrays of a .npz file.

    - `check`: raises any error if they are not what was written.

    **Raises:** `ValueError` that tells `remedy` if the file is damaged.
    """
    try:
        if not file.is_file():
            raise ValueError("there is no file")
        with np.load(file, allow_pickle=False) as saved:
            held = sum(member.file_size for member in saved.zip.infolist())
            # Headers are small, but count.
            if held > LARGEST + 2**20:
                raise ValueError(f"it unpacks to {held} bytes")
            arrays = {key: saved[key] for key in saved.files}
        check(arrays)
        return arrays
    # Whatever NumPy and zipfile raise on bits that were turned: some twenty kinds of error.
    except Exception as error:
        raise InputError(f"{file} is damaged ({error}): {remedy}") from error


def read_record(folder: Path, kind: str, remedy: str) -> dict[str, Any]:
    """The record of a folder, with its `config`.

    **Raises:** `ValueError` that tells `remedy` if there is none, or it has no configuration.
    """
    file, problem = folder / f"{kind}.json", f"is no {kind} record"
    record = read_json(file, problem, remedy)
    require(isinstance(record.get("config"), dict), f"{file} {problem} (it has no config): {remedy}")
    return record


@contextmanager
def writing_in(path: Path) -> Iterator[None]:
    """While this process writes in a folder; what a process that was killed has left of a file is removed first.

    **Raises:** `ValueError` if another process writes there, or it cannot be written.
    """
    lock = filelock.FileLock(path / _LOCK, timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout as error:
        raise InputError(
            f"{path} is being written by another process: wait until it ends, or choose another folder"
        ) from error
    # Of filelock, down to the least version that we allow (3.16): there are no locks on this file system.
    except (OSError, NotImplementedError) as error:
        raise InputError(f"cannot write in {path} ({error}): make room or choose another place") from error
    try:
        for left in path.glob(PARTS):
            left.unlink()
        yield
    finally:
        lock.release()


class ResultFolder:
    """A folder, and the configuration that its results have: a record, written with the first of them.

    - `config`: what JSON can say, see `jaxnbv.storage.describe`.
    - `arrays`: contents of its large arrays by their hashes, kept in arrays.npz.

    A subclass says of what `kind` its results are, after which the record is named, the `pattern` of their names, and
    the number of their `format`.

    **Raises:** `ValueError` if the folder cannot be made, or holds results of another configuration or other files.
    """

    kind: str
    pattern: str
    format: int

    def __init__(
        self, path: str | Path, config: dict[str, Any], arrays: Mapping[str, np.ndarray] = MappingProxyType({})
    ):
        self.path, self.config = make_folder(path), json.loads(json.dumps(config))
        self.arrays = dict(arrays)
        self.versions: dict[str, Any] = {}
        self.bound = False
        self._check()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """While this process writes results.

        **Raises:** `ValueError` if another process does, or the folder cannot be written.
        """
        with writing_in(self.path):
            # Another process may have written since this one looked.
            self._check()
            yield

    def set_versions(self, there: dict[str, Any]) -> None:
        """Set the `versions` of the process that computes the results to come. Warns if the folder has others."""
        self.versions = there
        if not self.bound:
            return
        written = read_record(self.path, self.kind, "choose another output folder")
        if other := differences(written.get("versions"), there):
            warnings.warn(
                f"{self.path} was begun with other versions ({'; '.join(other)}): new results may differ in their last "
                "bits from those of an uninterrupted run",
                stacklevel=3,
            )

    def bind(self) -> None:
        """Write the record and its arrays, if they are not there, before the first result is."""
        if not self.bound:
            record = {"format": self.format, "config": self.config, "versions": self.versions}
            # The record first: arrays alone would be of nobody.
            write_text(self.path / f"{self.kind}.json", json.dumps(record, indent=2))
            if self.arrays:
                write_arrays(self.path / ARRAYS, self.arrays)
            self.bound = True

    def _check(self) -> None:
        file = self.path / f"{self.kind}.json"
        if not file.exists():
            names = sorted(entry.name for entry in self.path.iterdir())
            foreign = [name for name in names if name != _LOCK and not name.endswith(".partial")]
            require(
                not foreign or self.kind == "study",
                f"the output folder {self.path} holds other files ({', '.join(foreign[:3])}): choose an empty folder",
            )
            return
        written = read_record(self.path, self.kind, "choose another output folder")
        check_format(written.get("format"), self.format, file)
        # A record without results is of a run that did not come far; it binds nobody.
        if not any(self.path.glob(self.pattern)):
            return
        changed = differences(written["config"], self.config)
        require(
            not changed,
            f"the output folder {self.path} belongs to another {self.kind}; it differs in {'; '.join(changed[:3])}. "
            "Choose another folder, or remove this one",
        )
        self.bound = True
