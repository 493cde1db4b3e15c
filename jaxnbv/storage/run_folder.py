"""An episode or a session on disk, written step by step.

episode.json      the configuration (planner, scene, noise, first pose, seed) and the versions that made it
arrays.npz        the configuration's large arrays (weights of networks, meshes) by the SHA-256 of their bytes; none if
                  it has none
view_00.npz       pose and scan of the first view; view_01.npz and so on also hold what the search proposed: candidates,
                  their values, and the trajectories of a gradient search
end_00.npz        why a rule ended the episode, and after how many views
cloud.ply         the points that were kept, in world units, once the episode is complete

session.json      the configuration (planner, sensor, box, what is up) and the versions that made it
image_00.npz      the first depth image as the sensor gave it, its pose and scale; image_01.npz and so on
proposal_01.npz   where the planner wanted the image of that number to be taken, and the depth expected there
refused_00.npz    a pose that was proposed and cannot be reached, and why; refused_01.npz and so on
"""

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
from jaxnbv.storage.files import write_whole
from jaxnbv.storage.folders import ResultFolder, read_arrays, versions, write_arrays
from jaxnbv.storage.rebuilding import read_config

# What is stored as several arrays.
_MODULES = {
    "pose": Pose,
    "scan": PointCloud,
    "proposal": Proposal,
    "candidates": Pose,
    "trajectories": Trajectories,
    "poses": Pose,
}


class RunFolder(ResultFolder):
    """The folder of an "episode" or a "session", open for one configuration: numbered files of arrays, which are
    checked when they are read.

    - `config`: parts of the configuration by their names, as they are: `RunFolder` describes them.

    **Raises:** `ValueError` if the folder holds results of another configuration, or other files.
    """

    # Not arrays.npz, which belongs to the record.
    pattern, format = "*_*.npz", 4

    def __init__(self, path: str | Path, kind: str, config: dict[str, Any]):
        self.kind = kind
        arrays: dict[str, np.ndarray] = {}
        described = {name: describe(part, arrays, name) for name, part in config.items()}
        super().__init__(path, described, arrays)
        self.set_versions(versions())

    @classmethod
    def config_of(cls, path: str | Path, kind: str, **given: Any) -> dict[str, Any]:
        """The configuration of an existing folder, see `read_config`."""
        return read_config(path, kind, cls.format, given)

    def count(self, name: str) -> int:
        """How many files of a name there are, of "view" say: view_00.npz, view_01.npz and so on.

        **Raises:** `ValueError` if one before the last is missing.
        """
        # By their names: a link to a file that is gone is an image that cannot be read.
        found = {file for file in os.listdir(self.path) if re.fullmatch(rf"{name}_\d{{2,}}\.npz", file)}
        for index in range(len(found)):
            file = self.file(name, index).name
            require(
                file in found,
                f"{self.path} holds {len(found)} of {name}_*.npz, but not {file}: restore it, or move those after it "
                "to another folder",
            )
        return len(found)

    def file(self, name: str, index: int) -> Path:
        """Where the file of a name and index lies."""
        return self.path / f"{name}_{index:02d}.npz"

    def write(self, name: str, index: int, **parts: Any) -> None:
        """Write a file, all or nothing; the first of them binds the folder to its configuration.

        - `parts`: modules, arrays or None, by their names.

        **Raises:** `ValueError` as `write_whole` does.
        """
        self.bind()
        leaves = jax.tree_util.tree_leaves_with_path(parts)
        arrays = {jax.tree_util.keystr(way, simple=True, separator="."): np.asarray(leaf) for way, leaf in leaves}
        arrays["index"] = np.asarray(index)
        sealed: dict[str, Any] = arrays | {"sha256": np.asarray(_checksum(arrays))}
        write_arrays(self.file(name, index), sealed)

    def read(self, name: str, index: int) -> dict[str, Any]:
        """The parts that were written; without those that were None.

        **Raises:** `ValueError` if the file is damaged, or not that of the index.
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
        """Write points and normals as a binary PLY file, in the coordinates that they have."""
        points, normals = cloud.to_numpy()
        # A mesh without faces: clouds of trimesh have no normals.
        bare = trimesh.Trimesh(points, vertex_normals=normals, process=False)
        content = trimesh.exchange.ply.export_ply(bare, vertex_normal=True)
        write_whole(self.path / "cloud.ply", lambda file: file.write(content))


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _parts(arrays: dict[str, Any]) -> dict[str, Any]:
    """Modules in place of their arrays, which are named by the ways to them."""
    parts: dict[str, Any] = {}
    for name, array in arrays.items():
        part, _, rest = name.partition(".")
        if rest:
            parts.setdefault(part, {})[rest] = jnp.asarray(array)
        else:
            parts[part] = array
    return {part: _MODULES[part](**_parts(held)) if isinstance(held, dict) else held for part, held in parts.items()}
