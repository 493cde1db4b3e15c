"""Episodes on disk: a folder of plain JSON, NumPy and PLY files, written view by view and never half a file.

episode.json    the configuration (planner, scene, noise, first pose, seed) and the versions that made it
view_00.npz     pose and scan of the first view; view_01.npz and on also hold the candidates and their values, and
                the trajectories of a gradient search
cloud.ply       the points that were kept, once the episode is complete
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import warnings
import zipfile
import zlib
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from plyfile import PlyData, PlyElement

from jaxnbv.camera import Pose
from jaxnbv.checks import InputError, require
from jaxnbv.cloud import PointCloud
from jaxnbv.files import write_whole
from jaxnbv.search import Proposal, Trajectories

_LARGEST_LISTED = 16


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


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on, and the kind of device."""
    names = ("jaxnbv", "jax", "jaxlib", "equinox", "optax", "optimistix", "numpy", "trimesh", "embreex")
    return {**{name: importlib.metadata.version(name) for name in names}, "device": jax.devices()[0].device_kind}


class EpisodeFolder:
    """An episode's folder, open for one configuration.

    **Raises:** `ValueError` if the folder holds an episode of another configuration, or files that are not an
    episode's.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        self.path = Path(path)
        require(
            not self.path.exists() or self.path.is_dir(),
            f"the output folder {self.path} is a file: choose another place",
        )
        record = self.path / "episode.json"
        if not record.exists():
            foreign = sorted(entry.name for entry in self.path.iterdir()) if self.path.exists() else []
            require(
                not [name for name in foreign if not name.endswith(".partial")],
                f"the output folder {self.path} holds other files ({', '.join(foreign[:3])}): choose an empty folder",
            )
            try:
                self.path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(
                    f"cannot make the output folder {self.path} ({error}): choose another place"
                ) from error
            text = json.dumps({"config": config, "versions": versions()}, indent=2)
            write_whole(record, lambda file: file.write(text.encode()))
            return
        try:
            written = json.loads(record.read_text())
            found, made_by = written["config"], written.get("versions")
        except (json.JSONDecodeError, KeyError, TypeError, UnicodeDecodeError) as error:
            raise InputError(f"{record} is not an episode's record ({error}): choose another output folder") from error
        changed = differences(found, json.loads(json.dumps(config)))
        require(
            not changed,
            f"the output folder {self.path} belongs to another configuration; it differs in {'; '.join(changed[:3])}. "
            "Choose another folder, or the settings it was made with",
        )
        if made_by != versions():
            warnings.warn(
                f"{self.path} was begun with other versions ({'; '.join(differences(made_by, versions()))}): "
                "new views may differ in their last bits from those of an uninterrupted run",
                stacklevel=3,
            )

    def read_views(self) -> list[tuple[Pose, PointCloud, Proposal | None]]:
        """Pose, scan and proposal of every finished view, up to the first that is missing."""
        views: list[tuple[Pose, PointCloud, Proposal | None]] = []
        while (file := self._view_file(len(views))).exists():
            try:
                with np.load(file, allow_pickle=False) as saved:
                    views.append(_view({name: jnp.asarray(saved[name]) for name in saved.files}))
            except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
                raise InputError(f"{file} is damaged ({error}): delete it, and its view is scanned again") from error
        return views

    def write_view(self, index: int, pose: Pose, scan: PointCloud, proposal: Proposal | None) -> None:
        """Write one finished view, all or nothing."""
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
        if proposal is not None and (ways := proposal.trajectories) is not None:
            data |= {
                "trajectory_rotations": ways.poses.rotation,
                "trajectory_positions": ways.poses.position,
                "trajectory_values": ways.values,
            }
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in data.items()}
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
    return pose, scan, Proposal(pose, data["value"], candidates, data["values"], trajectories)


def differences(found: Any, asked: Any, name: str = "") -> list[str]:
    if isinstance(found, dict) and isinstance(asked, dict):
        keys = list(dict.fromkeys([*found, *asked]))
        nested = (differences(found.get(key), asked.get(key), f"{name}.{key}".lstrip(".")) for key in keys)
        return [difference for group in nested for difference in group]
    return [] if found == asked else [f"{name}: {found} there, {asked} now"]
