"""Clouds that a pyramid classifier is trained, calibrated and tested on."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from jaxnbv.camera import Camera, Pose, look_at
from jaxnbv.cloud import PointCloud, concatenate, farthest_point_subsample, limit_capacity
from jaxnbv.datasets import Framing, Pyramid, Split, pyramid_scene
from jaxnbv.datasets.pyramid import scan_pattern
from jaxnbv.scanning import Grid, GridSurface, SensorNoise, scan
from jaxnbv.search.base import SENSOR_RADIUS
from jaxnbv.surfaces import SurfaceModel

MAX_VIEWS = 5


class LabelledClouds(eqx.Module):
    """A batch of clouds with their classes.

    - `clouds`: in scene units, thinned by farthest point sampling.
    - `labels`: indices of `PATTERNS`.
    - `pattern_pixels`: how many of the rays that were truly scanned hit the pattern.
    - `imagined`: whether the last view of the cloud is one of a posterior sample.
    """

    clouds: PointCloud
    labels: Int[Array, "*batch"]
    pattern_pixels: Int[Array, "*batch"]
    imagined: Bool[Array, "*batch"]


@eqx.filter_jit
def scanned_clouds(
    split: Split, framing: Framing, first: Int[Array, ""], count: int, num_points: int = 1024
) -> LabelledClouds:
    """Clouds of one to five random views, with the sensor's noise, of `count` scenes from scene `first` on."""

    def cloud_of(index):
        pyramid, key = pyramid_scene(split, index, framing), _key(split, index)
        cloud, pixels = _partial_cloud(pyramid, key, MAX_VIEWS)
        return LabelledClouds(farthest_point_subsample(cloud, num_points), pyramid.label, pixels, jnp.asarray(False))

    return jax.lax.map(cloud_of, first + jnp.arange(count))


class Imagination(eqx.Module):
    """How scans of posterior samples are made for training: as a planner makes them, from fewer samples and poses."""

    model: SurfaceModel
    grid: Grid
    num_samples: int = eqx.field(static=True, default=4)
    num_poses: int = eqx.field(static=True, default=4)
    capacity: int = eqx.field(static=True, default=2500)


@eqx.filter_jit
def imagined_clouds(
    split: Split, framing: Framing, index: Int[Array, ""], imagination: Imagination, num_points: int = 1024
) -> LabelledClouds:
    """D u scan(theta; f_s) of one scene: D of one to four random views, every f_s seen from its own random poses.

    The class is the true one, whatever the sample shows.
    """
    pyramid, key = pyramid_scene(split, index, framing), _key(split, index)
    cloud, pixels = _partial_cloud(pyramid, key, MAX_VIEWS - 1)

    posterior = imagination.model.condition(limit_capacity(cloud, imagination.capacity))
    fields = posterior.sample(jax.random.fold_in(key, 2), imagination.num_samples)
    surfaces = GridSurface.from_values(fields.on_grid(imagination.grid.axis), posterior.level, imagination.grid)
    seen = limit_capacity(cloud, num_points)

    def of_sample(surface_and_key):
        surface, pose_key = surface_and_key
        scans = scan(surface, Camera(), _random_poses(pose_key, imagination.num_poses))
        return jax.lax.map(lambda one: farthest_point_subsample(concatenate(seen, one), num_points), scans)

    keys = jax.random.split(jax.random.fold_in(key, 3), imagination.num_samples)
    clouds = jax.lax.map(of_sample, (surfaces, keys))
    clouds = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), clouds)
    total = imagination.num_samples * imagination.num_poses
    return LabelledClouds(clouds, *(jnp.full(total, value) for value in (pyramid.label, pixels, True)))


def _key(split: Split, index: Int[Array, ""]) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(1), list(Split).index(split)), index)


def _random_poses(key: PRNGKeyArray, count: int) -> Pose:
    direction = jax.random.normal(key, (count, 3))
    return look_at(SENSOR_RADIUS * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True))


def _partial_cloud(pyramid: Pyramid, key: PRNGKeyArray, most: int) -> tuple[PointCloud, Int[Array, ""]]:
    """What one to `most` random views show, and how many of their rays hit the pattern."""
    pose_key, noise_key = jax.random.split(key)
    pattern, scans = scan_pattern(pyramid, Camera(), _random_poses(pose_key, most))
    views = SensorNoise()(scans, noise_key)
    used = jnp.arange(most) < jax.random.randint(jax.random.fold_in(key, 1), (), 1, most + 1)
    views = PointCloud(views.points, views.normals, views.mask & used[:, None])
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), views), jnp.sum(jnp.where(used, pattern, 0))
