"""What training clouds are made of: some views of an object, and what a planner imagines that has seen them."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PRNGKeyArray

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Evidence


def stacked(trees: Sequence[Any]) -> Any:
    """Several alike as one, with a leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def merged(tree: Any) -> Any:
    """The two leading axes of all arrays as one."""
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), tree)


def random_poses(key: PRNGKeyArray, count: int, radius: float) -> Pose:
    """Uniform on a sphere about the scene's middle, looking at it."""
    direction = jax.random.normal(key, (count, 3))
    return look_at(radius * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True))


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
