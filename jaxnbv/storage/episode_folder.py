"""A simulated episode on disk, written view by view.

episode.json    the configuration (planner, scene, noise, first pose, seed) and the versions that made it
view_00.npz     pose and scan of the first view; view_01.npz and on also hold the candidates and their values, and
                the trajectories of a gradient search
cloud.ply       the points that were kept, once the episode is complete
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal
from jaxnbv.storage.arrays import (
    POSE,
    PROPOSAL,
    SCAN,
    pose_arrays,
    pose_of,
    proposal_arrays,
    proposal_of,
    read_arrays,
    scan_arrays,
    scan_of,
    write_arrays,
)
from jaxnbv.storage.files import write_whole
from jaxnbv.storage.folders import ResultFolder, read_config, writing_in

_RECORD, _VIEWS = "episode.json", "view_*.npz"
_VIEW = {**POSE, **SCAN, **PROPOSAL}


class EpisodeFolder(ResultFolder):
    """An episode's folder, open for one configuration.

    **Raises:** `ValueError` if the folder holds an episode of another configuration, or files that are not an
    episode's.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        super().__init__(path, _RECORD, _VIEWS, config, "episode")

    def read_views(self) -> list[tuple[Pose, PointCloud, Proposal | None]]:
        """Pose, scan and proposal of every finished view, up to the first that is missing.

        **Raises:** `ValueError` if one is damaged.
        """
        views: list[tuple[Pose, PointCloud, Proposal | None]] = []
        while (file := self._view_file(len(views))).exists():
            remedy = "delete it, and its view is scanned again"
            views.append(read_arrays(file, len(views), _VIEW, _view, "view", remedy))
        return views

    def write_view(self, index: int, pose: Pose, scan: PointCloud, proposal: Proposal | None) -> None:
        """Write one finished view, all or nothing; the first of them binds the folder to its configuration."""
        self.bind()
        chosen = {} if proposal is None else proposal_arrays(proposal)
        write_arrays(self._view_file(index), index, pose_arrays(pose) | scan_arrays(scan) | chosen)

    def write_cloud(self, cloud: PointCloud) -> None:
        """Write the kept points and normals as a binary PLY file, in scene coordinates."""
        points, normals = cloud.to_numpy()
        # A mesh without faces: clouds of trimesh have no normals.
        bare = trimesh.Trimesh(points, vertex_normals=normals, process=False)
        content = trimesh.exchange.ply.export_ply(bare, vertex_normal=True)
        write_whole(self.path / "cloud.ply", lambda file: file.write(content))

    def _view_file(self, index: int) -> Path:
        return self.path / f"view_{index:02d}.npz"


def open_episode(path: str | Path) -> EpisodeFolder:
    """The folder of an episode, whatever its configuration, which is its `config`.

    **Raises:** `ValueError` if it holds no episode.
    """
    record = Path(path) / _RECORD
    return EpisodeFolder(path, read_config(record, "is not an episode's record", "give the folder of a run"))


def remove_episode(path: str | Path) -> bool:
    """Remove the files of an episode from its folder, whatever its configuration; whether there were any.

    **Raises:** `ValueError` if another process writes there.
    """
    path = Path(path)
    if not (path / _RECORD).exists():
        return False
    with writing_in(path):
        # The record last, so that what is left of views is never foreign.
        for file in (*path.glob(_VIEWS), path / "cloud.ply", path / _RECORD):
            file.unlink(missing_ok=True)
    return True


def _view(data: dict[str, np.ndarray]) -> tuple[Pose, PointCloud, Proposal | None]:
    return pose_of(data), scan_of(data), proposal_of(data)
