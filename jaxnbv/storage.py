"""Episodes on disk: a folder of plain JSON, NumPy and PLY files, written view by view and never half a file.

episode.json    the configuration (planner, scene, noise, first pose, seed) and the versions that made it
view_00.npz     pose and scan of the first view; view_01.npz and on also hold the candidates and their values, and
                the trajectories of a gradient search
cloud.ply       the points that were kept, once the episode is complete
"""

import dataclasses
import functools
import hashlib
import json
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from plyfile import PlyData, PlyElement

from jaxnbv.checks import InputError, require
from jaxnbv.cloud import PointCloud
from jaxnbv.files import write_whole
from jaxnbv.folders import FORMAT, ResultFolder, check_format
from jaxnbv.pose import Pose
from jaxnbv.search import Proposal, Trajectories

_LARGEST_LISTED = 16
# In bytes, unpacked: sixteen million rays, far more than a camera has.
_LARGEST_VIEW = 2**29


def describe(thing: Any) -> Any:
    """A JSON description by which two configurations can be told apart.

    Modules and dataclasses become their fields, small arrays their values, large ones a hash of their bytes, functions
    their names and a hash of their code, defaults and closures, other objects their types' names.
    """
    if dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        fields = {field.name: describe(getattr(thing, field.name, None)) for field in dataclasses.fields(thing)}
        return {"type": type(thing).__qualname__, **fields}
    if isinstance(thing, jax.Array) and jnp.issubdtype(thing.dtype, jax.dtypes.prng_key):
        return {"type": str(jax.random.key_impl(thing)), "data": jax.random.key_data(thing).tolist()}
    if isinstance(thing, jax.Array | np.ndarray | np.generic):
        array = np.asarray(thing)
        if array.size <= _LARGEST_LISTED:
            return array.tolist()
        digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return {"shape": list(array.shape), "dtype": str(array.dtype), "sha256": digest}
    if isinstance(thing, dict):
        return {str(key): describe(value) for key, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [describe(value) for value in thing]
    if thing is None or isinstance(thing, bool | int | float | str):
        return thing
    if isinstance(thing, functools.partial):
        return {"partial": describe(thing.func), "arguments": describe([thing.args, thing.keywords])}
    if isinstance(thing, FunctionType):
        cells = [cell.cell_contents for cell in thing.__closure__ or ()]
        parts = [
            thing.__code__,
            thing.__defaults__,
            thing.__kwdefaults__,
            [cell for cell in cells if cell is not thing],
        ]
        digest = hashlib.sha256(json.dumps(describe(parts)).encode()).hexdigest()
        return {"function": thing.__qualname__, "sha256": digest}
    if isinstance(thing, CodeType):
        return describe([thing.co_code, thing.co_names, thing.co_consts])
    if isinstance(thing, set | frozenset):
        return sorted(map(repr, thing))
    if isinstance(thing, bytes | complex):
        return repr(thing)
    if hasattr(thing, "__wrapped__"):
        return describe(thing.__wrapped__)
    return getattr(thing, "__qualname__", type(thing).__qualname__)


class EpisodeFolder(ResultFolder):
    """An episode's folder, open for one configuration.

    **Raises:** `ValueError` if the folder holds an episode of another configuration, or files that are not an
    episode's.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        super().__init__(path, "episode.json", "view_*.npz", config, "episode")

    def read_views(self) -> list[tuple[Pose, PointCloud, Proposal | None]]:
        """Pose, scan and proposal of every finished view, up to the first that is missing."""
        views: list[tuple[Pose, PointCloud, Proposal | None]] = []
        while (file := self._view_file(len(views))).exists():
            try:
                with np.load(file, allow_pickle=False) as saved:
                    held = sum(member.file_size for member in saved.zip.infolist())
                    require(held <= _LARGEST_VIEW, f"{file} is damaged (it unpacks to {held} bytes): delete it")
                    data = {name: saved[name] for name in saved.files}
                _check_view(data, len(views), file)
                views.append(_view({name: jnp.asarray(data[name]) for name in _ARRAYS if name in data}))
            except InputError:
                raise
            # Whatever NumPy and zipfile raise on bits that were turned: some twenty kinds of error.
            except Exception as error:
                raise InputError(f"{file} is damaged ({error}): delete it, and its view is scanned again") from error
        return views

    def write_view(self, index: int, pose: Pose, scan: PointCloud, proposal: Proposal | None) -> None:
        """Write one finished view, all or nothing; the first of them binds the folder to its configuration."""
        self.bind()
        data = {
            "rotation": pose.rotation,
            "position": pose.position,
            "points": scan.points,
            "normals": scan.normals,
            "mask": scan.mask,
        }
        if scan.missed is not None:
            data["missed"] = scan.missed
        if proposal is not None:
            data |= {
                "value": proposal.value,
                "values": proposal.values,
                "candidate_rotations": proposal.candidates.rotation,
                "candidate_positions": proposal.candidates.position,
            }
            errors = {name: getattr(proposal, name) for name in _ERRORS}
            data |= {name: value for name, value in errors.items() if value is not None}
        if proposal is not None and (ways := proposal.trajectories) is not None:
            data |= {
                "trajectory_rotations": ways.poses.rotation,
                "trajectory_positions": ways.poses.position,
                "trajectory_values": ways.values,
            }
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in data.items()}
        arrays |= {"format": np.asarray(FORMAT), "index": np.asarray(index)}
        arrays["sha256"] = np.asarray(_checksum(arrays))
        write_whole(self._view_file(index), lambda file: np.savez_compressed(file, **arrays))

    def write_cloud(self, cloud: PointCloud) -> None:
        """Write the kept points and normals as a binary PLY file, in scene coordinates."""
        points, normals = cloud.to_numpy()
        rows = np.concatenate([points, normals], axis=1)
        vertices = np.rec.fromarrays(list(rows.T), dtype=[(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
        ply = PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=["scene coordinates"])
        write_whole(self.path / "cloud.ply", ply.write)

    def _view_file(self, index: int) -> Path:
        return self.path / f"view_{index:02d}.npz"


_ERRORS = ("standard_errors", "difference_errors")
# What a view's arrays are: the kind of their type, and their shape; what one letter stands for is the same in all.
_ARRAYS = {
    "rotation": ("f", (3, 3)),
    "position": ("f", (3,)),
    "points": ("f", ("n", 3)),
    "normals": ("f", ("n", 3)),
    "mask": ("b", ("n",)),
    "missed": ("b", ("n",)),
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


def _check_view(data: dict[str, np.ndarray], index: int, file: Path) -> None:
    """**Raises:** `ValueError` that says what is damaged; `InputError` for a later format."""
    lengths: dict[str, int] = {}
    for name, (kind, shape) in _ARRAYS.items():
        if name in data:
            array = data[name]
            fits = array.dtype.kind == kind and array.ndim == len(shape)
            fits = fits and all(
                length == (lengths.setdefault(axis, length) if isinstance(axis, str) else axis)
                for axis, length in zip(shape, array.shape, strict=True)
            )
            if not fits:
                raise ValueError(f"its {name} is {array.dtype}{list(array.shape)}")
    # Folders of format 1 say none of these.
    if "format" in data:
        check_format(int(data["format"]), file)
        if int(data["index"]) != index:
            raise ValueError(f"it is view {int(data['index'])}")
        if str(data["sha256"]) != _checksum({name: array for name, array in data.items() if name != "sha256"}):
            raise ValueError("its checksum is not that of its arrays")


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _view(data: dict[str, jax.Array]) -> tuple[Pose, PointCloud, Proposal | None]:
    pose = Pose(data["rotation"], data["position"])
    # Folders of earlier versions do not say which rays met nothing.
    scan = PointCloud(data["points"], data["normals"], data["mask"], data.get("missed"))
    if "values" not in data:
        return pose, scan, None
    candidates = Pose(data["candidate_rotations"], data["candidate_positions"])
    trajectories = None
    if "trajectory_values" in data:
        poses = Pose(data["trajectory_rotations"], data["trajectory_positions"])
        trajectories = Trajectories(poses, data["trajectory_values"])
    errors = (data.get(name) for name in _ERRORS)
    return pose, scan, Proposal(pose, data["value"], candidates, data["values"], trajectories, *errors)
