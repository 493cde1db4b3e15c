"""The folder of an episode or a session, written step by step.

episode.json      the configuration (planner, scene, noise, first pose, seed) and the versions of the software
arrays.npz        large arrays of the configuration, if any (weights of networks, meshes), keyed by their SHA-256
view_00.npz       pose and scan of the first view; view_01.npz and so on also hold the search's proposal: candidates,
                  their values, and the trajectories of a gradient search
end_00.npz        the reason why a stop rule ended the episode, and the number of views
cloud.ply         the points of the cloud, in world units, once the episode is complete

session.json      the configuration (planner, sensor, box, upward axis) and the versions of the software
image_00.npz      the first depth image of the sensor, its pose and scale; image_01.npz and so on
proposal_01.npz   the search's proposal for the image with this number: pose, candidates, values and trajectories
refused_00.npz    a proposed pose that cannot be reached, and the reason; refused_01.npz and so on
"""

import functools
import hashlib
import os
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from jaxnbv.checks import require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal, Trajectories
from jaxnbv.storage.description import describe
from jaxnbv.storage.files import write_bytes
from jaxnbv.storage.folders import ResultFolder, read_arrays, versions, write_arrays
from jaxnbv.storage.rebuilding import read_config

# Classes of the parts that are stored as several arrays, keyed by the part's name.
_MODULES = {
    "pose": Pose,
    "scan": PointCloud,
    "proposal": Proposal,
    "candidates": Pose,
    "trajectories": Trajectories,
    "poses": Pose,
}


class RunFolder(ResultFolder):
    """The folder of an episode or a session: a record of the configuration, and numbered files of arrays.

    - `kind`: "episode" or "session".
    - `config`: parts of the configuration, keyed by name. The record has their descriptions, see `describe`.

    **Raises:** `ValueError` if the folder holds results of a different configuration, or other files.
    """

    # The pattern does not match arrays.npz, which belongs to the record.
    pattern, format = "*_*.npz", 4

    def __init__(self, path: str | Path, kind: str, config: dict[str, Any]):
        self.kind = kind
        arrays: dict[str, np.ndarray] = {}
        descriptions = {name: describe(part, arrays, name) for name, part in config.items()}
        super().__init__(path, descriptions, arrays)
        self.set_versions(versions())

    @classmethod
    def config_of(cls, path: str | Path, kind: str, **replacements: Any) -> dict[str, Any]:
        """Rebuild the configuration of an existing folder, see `read_config`."""
        return read_config(path, kind, cls.format, replacements)

    def count(self, name: str) -> int:
        """Count the files with a name, such as "view" for view_00.npz, view_01.npz and so on.

        **Raises:** `ValueError` if a file before the last one is missing.
        """
        # A broken link counts as a file, so that reading it raises an error.
        names = {file for file in os.listdir(self.path) if re.fullmatch(rf"{name}_\d{{2,}}\.npz", file)}
        for index in range(len(names)):
            file = self.file(name, index).name
            require(
                file in names,
                f"{self.path} holds {len(names)} of {name}_*.npz, but not {file}: restore it, or move those after it "
                "to another folder",
            )
        return len(names)

    def file(self, name: str, index: int) -> Path:
        """Return the path of the file with this name and index."""
        return self.path / f"{name}_{index:02d}.npz"

    def write(self, name: str, index: int, **parts: Any) -> None:
        """Write a file, as `write_arrays` does. The first call also writes the record of the folder.

        - `parts`: Equinox modules, arrays or None, keyed by name.

        **Raises:** `ValueError` whenever `write_arrays` raises it.
        """
        self.bind()
        name_of = functools.partial(jax.tree_util.keystr, simple=True, separator=".")
        arrays = {name_of(key): np.asarray(leaf) for key, leaf in jax.tree_util.tree_leaves_with_path(parts)}
        arrays["index"] = np.asarray(index)
        contents: dict[str, Any] = arrays | {"sha256": np.asarray(_checksum(arrays))}
        write_arrays(self.file(name, index), contents)

    def read(self, name: str, index: int) -> dict[str, Any]:
        """Read the parts in a file, keyed by name. Parts that were None are absent.

        **Raises:** `ValueError` if the file is missing or damaged, or if its stored checksum or index is wrong.
        """

        def check(arrays: dict[str, np.ndarray]) -> None:
            checksum = str(arrays.pop("sha256"))
            if int(arrays["index"]) != index:
                raise ValueError(f"it is {name} {int(arrays['index'])}")
            if checksum != _checksum(arrays):
                raise ValueError("its checksum is not that of its arrays")

        arrays = read_arrays(self.file(name, index), "restore it, or delete it and those after it", check)
        del arrays["index"]
        return _parts(arrays)

    def write_cloud(self, cloud: PointCloud) -> None:
        """Write points and normals to cloud.ply, in the coordinates of `cloud`."""
        write_bytes(self.path / "cloud.ply", ply_of(cloud))


def ply_of(cloud: PointCloud) -> bytes:
    """Return the content of a binary PLY file with points and normals."""
    points, normals = cloud.to_numpy()
    # Use a mesh without faces, because trimesh's point clouds have no normals.
    mesh = trimesh.Trimesh(points, vertex_normals=normals, process=False)
    return trimesh.exchange.ply.export_ply(mesh, vertex_normal=True)


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _parts(arrays: dict[str, Any]) -> dict[str, Any]:
    """Join arrays with keys such as "scan.points" to modules. Returns modules and other arrays by name."""
    parts: dict[str, Any] = {}
    for name, array in arrays.items():
        part, _, rest = name.partition(".")
        if rest:
            parts.setdefault(part, {})[rest] = jnp.asarray(array)
        else:
            parts[part] = array
    return {name: _MODULES[name](**_parts(part)) if isinstance(part, dict) else part for name, part in parts.items()}
