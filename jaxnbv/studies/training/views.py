"""What training clouds are made of: some views of an object, and what a planner imagines that has seen them."""

from jaxtyping import Array, Bool

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence


def only(views: PointCloud, used: Bool[Array, " v"]) -> PointCloud:
    """The views (v, rays) that are used; all rays of the others are invalid."""
    used = used[:, None]
    missed = None if views.missed is None else views.missed & used
    return PointCloud(views.points, views.normals, views.mask & used, missed)


def joined_views(views: PointCloud) -> PointCloud:
    """The points of all views (v, rays) as one cloud."""
    points, normals, mask = views.points.reshape(-1, 3), views.normals.reshape(-1, 3), views.mask.reshape(-1)
    return PointCloud(points, normals, mask)


def evidence_after(planner: Planner, views: PointCloud, poses: Pose, camera: Camera) -> Evidence:
    """What a planner knows after all views (v, rays), taken by a camera. Runs under `jit`."""
    seen = ((poses[index], views[index], camera) for index in range(views.mask.shape[0]))
    *_, last = planner.replay(seen)
    return last
