"""Clouds that a pyramid classifier is trained, calibrated and tested on."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from jaxnbv.camera import Camera
from jaxnbv.cloud import PointCloud, concatenate, farthest_point_subsample, limit_capacity
from jaxnbv.datasets import Framing, Pyramid, Split, pyramid_scene
from jaxnbv.datasets.pyramid import scan_pattern
from jaxnbv.planner import Planner
from jaxnbv.pose import Pose, look_at
from jaxnbv.scanning import SensorNoise, scan
from jaxnbv.sensors import SENSOR_RADIUS
from jaxnbv.training.views import joined_views, only, state_after

MAX_VIEWS = 5


class LabelledClouds(eqx.Module):
    """A batch of clouds with their classes.

    - `clouds`: in scene units, thinned by farthest point sampling.
    - `labels`: indices of `PATTERNS`.
    - `views`: how many true views the cloud is of.
    - `pattern_pixels`: the most rays of one of these views that hit the pattern.
    - `imagined`: whether a view of a posterior sample was added to them.
    """

    clouds: PointCloud
    labels: Int[Array, "*batch"]
    views: Int[Array, "*batch"]
    pattern_pixels: Int[Array, "*batch"]
    imagined: Bool[Array, "*batch"]


@eqx.filter_jit
def scanned_clouds(
    split: Split, framing: Framing, first: Int[Array, ""], count: int, num_points: int = 1024
) -> LabelledClouds:
    """Clouds of one to five random views, with the sensor's noise, of `count` scenes from scene `first` on."""

    def cloud_of(index):
        pyramid, key = pyramid_scene(split, index, framing), _key(split, index)
        views, _, count, pixels = _partial_views(pyramid, key, MAX_VIEWS)
        cloud = farthest_point_subsample(joined_views(views), num_points)
        return LabelledClouds(cloud, pyramid.label, count, pixels, jnp.asarray(False))

    return jax.lax.map(cloud_of, first + jnp.arange(count))


@eqx.filter_jit
def imagined_clouds(
    split: Split, framing: Framing, index: Int[Array, ""], planner: Planner, num_poses: int = 4, num_points: int = 1024
) -> LabelledClouds:
    """D u scan(theta; f_s) of one scene: D of one to four random views, every f_s seen from its own random poses.

    The samples are those of a planner that has seen D. The class is the true one, whatever a sample shows.
    """
    pyramid = pyramid_scene(split, index, framing)
    key, sample_key, pose_key = jax.random.split(_key(split, index), 3)
    views, poses, count, pixels = _partial_views(pyramid, key, MAX_VIEWS - 1)
    surfaces = planner.sample_surfaces(state_after(planner, views, poses, Camera()), sample_key)
    seen = limit_capacity(joined_views(views), num_points)

    def of_sample(surface_and_key):
        surface, pose_key = surface_and_key
        scans = scan(surface, Camera(), _random_poses(pose_key, num_poses))
        return jax.lax.map(lambda one: farthest_point_subsample(concatenate(seen, one), num_points), scans)

    keys = jax.random.split(pose_key, planner.num_samples)
    clouds = jax.lax.map(of_sample, (surfaces, keys))
    clouds = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), clouds)
    total = planner.num_samples * num_poses
    return LabelledClouds(clouds, *(jnp.full(total, value) for value in (pyramid.label, count, pixels, True)))


def _key(split: Split, index: Int[Array, ""]) -> PRNGKeyArray:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(1), list(Split).index(split)), index)


def _random_poses(key: PRNGKeyArray, count: int) -> Pose:
    direction = jax.random.normal(key, (count, 3))
    return look_at(SENSOR_RADIUS * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True))


def _partial_views(
    pyramid: Pyramid, key: PRNGKeyArray, most: int
) -> tuple[PointCloud, Pose, Int[Array, ""], Int[Array, ""]]:
    """What one to `most` random views show, their poses, how many they are, and the most pattern pixels of one."""
    pose_key, noise_key, count_key = jax.random.split(key, 3)
    poses = _random_poses(pose_key, most)
    pattern, scans = scan_pattern(pyramid, Camera(), poses)
    count = jax.random.randint(count_key, (), 1, most + 1)
    used = jnp.arange(most) < count
    return only(SensorNoise()(scans, noise_key), used), poses, count, jnp.max(jnp.where(used, pattern, 0))
