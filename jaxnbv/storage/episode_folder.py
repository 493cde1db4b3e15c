"""A simulated episode on disk, written view by view.

episode.json    the configuration (planner, scene, noise, first pose, seed) and the versions that made it
view_00.npz     pose and scan of the first view; view_01.npz and on also hold the candidates and their values, and
                the trajectories of a gradient search
cloud.ply       the points that were kept, once the episode is complete
"""

import jax.numpy as jnp
import numpy as np
import trimesh

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.search import Proposal
from jaxnbv.storage.arrays import POSE, PROPOSAL, SCAN, ArrayFile, arrays_of, pose_of, proposal_of
from jaxnbv.storage.files import write_whole
from jaxnbv.storage.folders import ResultFolder

_VIEW = ArrayFile("view", (*POSE, *SCAN, *PROPOSAL), "delete it, and its view is scanned again")


class EpisodeFolder(ResultFolder):
    """An episode's folder, open for one configuration.

    **Raises:** `ValueError` if the folder holds an episode of another configuration, or files that are not an
    episode's.
    """

    kind, record_name, results = "episode", "episode.json", "view_*.npz"
    problem, remedy = "is not an episode's record", "give the folder of a run"

    def read_views(self) -> list[tuple[Pose, PointCloud, Proposal | None]]:
        """Pose, scan and proposal of every finished view, up to the first that is missing.

        **Raises:** `ValueError` if one is damaged.
        """
        views: list[tuple[Pose, PointCloud, Proposal | None]] = []
        while _VIEW.path(self.path, len(views)).exists():
            views.append(_VIEW.read(self.path, len(views), _view))
        return views

    def write_view(self, index: int, pose: Pose, scan: PointCloud, proposal: Proposal | None) -> None:
        """Write one finished view, all or nothing; the first of them binds the folder to its configuration."""
        self.bind()
        data = arrays_of(pose, POSE) | arrays_of(scan, SCAN) | arrays_of(proposal, PROPOSAL)
        _VIEW.write(self.path, index, data)

    def write_cloud(self, cloud: PointCloud) -> None:
        """Write the kept points and normals as a binary PLY file, in scene coordinates."""
        points, normals = cloud.to_numpy()
        # A mesh without faces: clouds of trimesh have no normals.
        bare = trimesh.Trimesh(points, vertex_normals=normals, process=False)
        content = trimesh.exchange.ply.export_ply(bare, vertex_normal=True)
        write_whole(self.path / "cloud.ply", lambda file: file.write(content))


def _view(data: dict[str, np.ndarray]) -> tuple[Pose, PointCloud, Proposal | None]:
    scan = PointCloud(**{name: jnp.asarray(data[name]) for name in SCAN if name in data})
    return pose_of(data), scan, proposal_of(data)
