"""Numbered files of arrays in a folder of results: their kinds and shapes are known, and checked when they are read."""

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import jax.numpy as jnp
import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal, Trajectories
from jaxnbv.storage.files import write_whole
from jaxnbv.storage.folders import FORMAT, check_format

T = TypeVar("T")
Schema: TypeAlias = Mapping[str, tuple[str, tuple[int | str, ...]]]
"""Of each array the kinds that its type may have, and its shape; what a letter stands for is the same in all."""

# In bytes, unpacked: sixteen million rays, far more than a camera has.
_LARGEST = 2**29

POSE: Schema = {"rotation": ("f", (3, 3)), "position": ("f", (3,))}
SCAN: Schema = {
    "points": ("f", ("n", 3)),
    "normals": ("f", ("n", 3)),
    "mask": ("b", ("n",)),
    "missed": ("b", ("n",)),
}
PROPOSAL: Schema = {
    "value": ("f", ()),
    "values": ("f", ("c",)),
    "candidate_rotations": ("f", ("c", 3, 3)),
    "candidate_positions": ("f", ("c", 3)),
    "standard_errors": ("f", ("c",)),
    "difference_errors": ("f", ("c",)),
    "trajectory_rotations": ("f", ("s", "i", 3, 3)),
    "trajectory_positions": ("f", ("s", "i", 3)),
    "trajectory_values": ("f", ("s", "i")),
}
_ERRORS = ("standard_errors", "difference_errors")


def write_arrays(file: Path, index: int, data: Mapping[str, Any]) -> None:
    """Write the file of an index, all or nothing, with a checksum.

    **Raises:** `ValueError` as `write_whole` does.
    """
    arrays: dict[str, Any] = {name: np.asarray(value) for name, value in data.items()}
    arrays |= {"format": np.asarray(FORMAT), "index": np.asarray(index)}
    arrays["sha256"] = np.asarray(_checksum(arrays))
    write_whole(file, lambda opened: np.savez_compressed(opened, **arrays))


def read_arrays(
    file: Path, index: int, schema: Schema, make: Callable[[dict[str, np.ndarray]], T], what: str, remedy: str
) -> T:
    """What is made of those arrays of a file that the schema names; it need not hold all of them.

    - `what` and `remedy`: what the file should be, "view" say, and what to do if it is damaged, for the error.

    **Raises:** `ValueError` if it is damaged, or not that of the index.
    """
    try:
        if not file.is_file():
            raise ValueError("there is no file")
        with np.load(file, allow_pickle=False) as saved:
            held = sum(member.file_size for member in saved.zip.infolist())
            require(held <= _LARGEST, f"{file} is damaged (it unpacks to {held} bytes): delete it")
            data = {name: saved[name] for name in saved.files}
        _check(data, index, schema, file, what)
        return make({name: array for name, array in data.items() if name in schema})
    except InputError:
        raise
    # Whatever NumPy and zipfile raise on bits that were turned: some twenty kinds of error.
    except Exception as error:
        raise InputError(f"{file} is damaged ({error}): {remedy}") from error


def _check(data: dict[str, np.ndarray], index: int, schema: Schema, file: Path, what: str) -> None:
    """**Raises:** `ValueError` that says what is damaged; `InputError` for a later format."""
    lengths: dict[str, int] = {}
    for name, (kinds, shape) in schema.items():
        if name in data:
            array = data[name]
            fits = array.dtype.kind in kinds and array.ndim == len(shape)
            fits = fits and all(
                length == (lengths.setdefault(axis, length) if isinstance(axis, str) else axis)
                for axis, length in zip(shape, array.shape, strict=True)
            )
            if not fits:
                raise ValueError(f"its {name} is {array.dtype}{list(array.shape)}")
    check_format(int(data["format"]), file)
    if int(data["index"]) != index:
        raise ValueError(f"it is {what} {int(data['index'])}")
    if str(data["sha256"]) != _checksum({name: array for name, array in data.items() if name != "sha256"}):
        raise ValueError("its checksum is not that of its arrays")


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def pose_arrays(pose: Pose) -> dict[str, Any]:
    return {"rotation": pose.rotation, "position": pose.position}


def scan_arrays(scan: PointCloud) -> dict[str, Any]:
    known = {"points": scan.points, "normals": scan.normals, "mask": scan.mask}
    return known if scan.missed is None else known | {"missed": scan.missed}


def proposal_arrays(proposal: Proposal) -> dict[str, Any]:
    """All but the pose."""
    data = {
        "value": proposal.value,
        "values": proposal.values,
        "candidate_rotations": proposal.candidates.rotation,
        "candidate_positions": proposal.candidates.position,
    }
    errors = {name: getattr(proposal, name) for name in _ERRORS}
    data |= {name: value for name, value in errors.items() if value is not None}
    if (ways := proposal.trajectories) is not None:
        data |= {
            "trajectory_rotations": ways.poses.rotation,
            "trajectory_positions": ways.poses.position,
            "trajectory_values": ways.values,
        }
    return data


def pose_of(data: Mapping[str, np.ndarray]) -> Pose:
    return Pose(data["rotation"], data["position"])


def scan_of(data: Mapping[str, np.ndarray]) -> PointCloud:
    rows = {name: jnp.asarray(data[name]) for name in SCAN if name in data}
    return PointCloud(**rows)


def proposal_of(data: Mapping[str, np.ndarray]) -> Proposal | None:
    """None where the file holds none."""
    if "values" not in data:
        return None
    trajectories = None
    if "trajectory_values" in data:
        poses = Pose(data["trajectory_rotations"], data["trajectory_positions"])
        trajectories = Trajectories(poses, jnp.asarray(data["trajectory_values"]))
    errors = (None if data.get(name) is None else jnp.asarray(data[name]) for name in _ERRORS)
    candidates = Pose(data["candidate_rotations"], data["candidate_positions"])
    value, values = jnp.asarray(data["value"]), jnp.asarray(data["values"])
    return Proposal(pose_of(data), value, candidates, values, trajectories, *errors)
