"""A planner at a real sensor: its rays, its box, its poses."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import GridSurface, scan_samples
from jaxnbv.search import GivenPoses
from jaxnbv.search.base import CandidateSearch

# A cloud holds some thousands of points; more rays than these only take time.
_MOST_RAYS = 20_000


def stride_of(camera: Camera) -> int:
    """The stride that leaves as many rays of an image as are worth their time."""
    return math.ceil(math.sqrt(camera.num_rays / _MOST_RAYS))


def planner_at(planner: Planner, camera: Camera, box: Box, poses: Pose | None) -> Planner:
    """A planner at a sensor, all in scene coordinates: see `Session`.

    - `poses`: where the search may look from, or None for its own candidates.

    **Raises:** `ValueError` if the search does not choose among poses.
    """
    usual = Box()

    def placed(leaf):
        default = isinstance(leaf, Box) and (leaf.low, leaf.high) == (usual.low, usual.high)
        return box if default else leaf

    planner = jax.tree.map(placed, planner, is_leaf=lambda leaf: isinstance(leaf, Box))
    imagined = camera.resized(planner.camera.height, planner.camera.width)
    if poses is None:
        return dataclasses.replace(planner, camera=imagined)
    if not isinstance(planner.search, CandidateSearch):
        raise InputError(
            f"the session was given poses, but {type(planner.search).__name__} is no search over candidates: use "
            "DiscreteSearch() or HalvingSearch()"
        )
    search = dataclasses.replace(planner.search, candidates=GivenPoses(poses))
    return dataclasses.replace(planner, camera=imagined, search=search)


@eqx.filter_jit
def expected_depth(planner: Planner, surfaces: GridSurface, pose: Pose) -> Float[Array, "h w"]:
    """What `mean_depth` is of the planner's camera and samples."""
    camera = planner.camera
    scans = scan_samples(surfaces, camera, pose[None], planner.barrier(pose[None]))
    return mean_depth(jax.tree.map(lambda rows: rows[:, 0], scans), pose).reshape(camera.height, camera.width)


@eqx.filter_jit
def mean_depth(scans: PointCloud, pose: Pose) -> Float[Array, " rays"]:
    """Mean depth along the camera's axis (scene units) over the samples that a ray hits; NaN where it misses most.

    `scans`: of all samples from the pose, along a leading axis.
    """
    depth = jnp.einsum("snd,d->sn", scans.points - pose.position, pose.forward, precision="highest")
    count = jnp.sum(scans.mask, axis=0)
    mean = jnp.sum(jnp.where(scans.mask, depth, 0.0), axis=0) / jnp.maximum(count, 1)
    return jnp.where(2 * count >= scans.mask.shape[0], mean, jnp.nan)
