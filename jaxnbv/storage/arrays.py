"""Numbered files of arrays in a folder of results: they are sealed by a checksum, and checked when they are read."""

import hashlib
from collections.abc import Callable, Mapping
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal, Trajectories
from jaxnbv.storage.files import write_whole
from jaxnbv.storage.folders import FORMAT, check_format

T = TypeVar("T")

# In bytes, unpacked: sixteen million rays, far more than a camera has.
_LARGEST = 2**29

# Names of arrays, which are checked by their checksum when they are read.
POSE = ("rotation", "position")
SCAN = ("points", "normals", "mask", "missed")
PROPOSAL = (
    "value",
    "values",
    "candidate_rotations",
    "candidate_positions",
    "standard_errors",
    "difference_errors",
    "trajectory_rotations",
    "trajectory_positions",
    "trajectory_values",
)
# Where a proposal keeps what it does not keep under the array's own name.
_PLACES = {
    "candidate_rotations": "candidates.rotation",
    "candidate_positions": "candidates.position",
    "trajectory_rotations": "trajectories.poses.rotation",
    "trajectory_positions": "trajectories.poses.position",
    "trajectory_values": "trajectories.values",
}


class ArrayFile(NamedTuple):
    """A kind of numbered file in a folder.

    - `name`: what one is, "view" say; files are called view_00.npz, view_01.npz and so on.
    - `arrays`: names of those that one may hold; it need not hold all of them.
    - `remedy`: what to do about one that is damaged, for the error.
    """

    name: str
    arrays: tuple[str, ...]
    remedy: str

    def path(self, folder: Path, index: int) -> Path:
        """The file of an index."""
        return folder / f"{self.name}_{index:02d}.npz"

    def write(self, folder: Path, index: int, data: Mapping[str, Any]) -> None:
        """Write the file of an index, all or nothing, with a checksum.

        **Raises:** `ValueError` as `write_whole` does.
        """
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in data.items()}
        arrays |= {"format": np.asarray(FORMAT), "index": np.asarray(index)}
        arrays["sha256"] = np.asarray(_checksum(arrays))
        write_whole(self.path(folder, index), lambda opened: np.savez_compressed(opened, **arrays))

    def read(self, folder: Path, index: int, make: Callable[[dict[str, np.ndarray]], T]) -> T:
        """What is made of those arrays of a file that are known.

        **Raises:** `ValueError` if it is damaged, or not that of the index.
        """
        file = self.path(folder, index)
        try:
            if not file.is_file():
                raise ValueError("there is no file")
            with np.load(file, allow_pickle=False) as saved:
                held = sum(member.file_size for member in saved.zip.infolist())
                require(held <= _LARGEST, f"{file} is damaged (it unpacks to {held} bytes): delete it")
                data = {name: saved[name] for name in saved.files}
            check_format(int(data["format"]), file)
            if int(data["index"]) != index:
                raise ValueError(f"it is {self.name} {int(data['index'])}")
            if str(data["sha256"]) != _checksum({name: array for name, array in data.items() if name != "sha256"}):
                raise ValueError("its checksum is not that of its arrays")
            return make({name: array for name, array in data.items() if name in self.arrays})
        except InputError:
            raise
        # Whatever NumPy and zipfile raise on bits that were turned: some twenty kinds of error.
        except Exception as error:
            raise InputError(f"{file} is damaged ({error}): {self.remedy}") from error


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def arrays_of(thing: Any, names: tuple[str, ...]) -> dict[str, Any]:
    """Those of some arrays that a pose, scan, proposal or image has; none of None."""
    found = {name: reduce(_held, _PLACES.get(name, name).split("."), thing) for name in names}
    return {name: value for name, value in found.items() if value is not None}


def _held(thing: Any, name: str) -> Any:
    return None if thing is None else getattr(thing, name)


def pose_of(data: Mapping[str, np.ndarray]) -> Pose:
    return Pose(data["rotation"], data["position"])


def proposal_of(data: Mapping[str, np.ndarray]) -> Proposal | None:
    """None where the file holds none."""
    if "values" not in data:
        return None
    held = {name: jnp.asarray(data[name]) for name in PROPOSAL if name in data}
    trajectories = None
    if "trajectory_values" in held:
        poses = Pose(held["trajectory_rotations"], held["trajectory_positions"])
        trajectories = Trajectories(poses, held["trajectory_values"])
    candidates = Pose(held["candidate_rotations"], held["candidate_positions"])
    errors = (held.get(name) for name in ("standard_errors", "difference_errors"))
    return Proposal(pose_of(data), held["value"], candidates, held["values"], trajectories, *errors)
