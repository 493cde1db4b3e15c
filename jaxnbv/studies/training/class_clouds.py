"""Clouds that a classifier is trained, calibrated and tested on."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, Key, PRNGKeyArray

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate, farthest_point_subsample, limit_capacity
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import SensorNoise, scan
from jaxnbv.scanning.sensors import SENSOR_RADIUS
from jaxnbv.studies.scenes import ClassObject, ClassSet, Framing, Split
from jaxnbv.studies.scenes.class_object import scan_cue
from jaxnbv.studies.scenes.splits import scene_key
from jaxnbv.studies.training.views import evidence_after, joined_views, merged, only, random_poses, stacked

MAX_VIEWS = 5
# Three standard deviations of the sensor's.
_NOISE = 3 * SensorNoise().points


class LabelledClouds(eqx.Module):
    """A batch of clouds with their classes.

    - `clouds`: in scene units, thinned by farthest point sampling.
    - `labels`: those of the objects.
    - `views`: how many true views the cloud is of.
    - `cue_pixels`: the most rays of one of these views that hit the cue of the class.
    - `imagined`: whether a view of a posterior sample was added to them.
    - `on_cue`: which points lie on the cue, up to the sensor's noise.
    """

    clouds: PointCloud
    labels: Int[Array, "*batch"]
    views: Int[Array, "*batch"]
    cue_pixels: Int[Array, "*batch"]
    imagined: Bool[Array, "*batch"]
    on_cue: Bool[Array, "*batch points"]


def scanned_clouds(
    scenes: ClassSet, split: Split, framing: Framing, indices: Sequence[int], num_points: int = 1024
) -> LabelledClouds:
    """A cloud of each scene, of one to five random views with the sensor's noise."""
    objects = [scenes.scene(split, index, framing) for index in indices]
    keys = jax.vmap(lambda index: scene_key(1, split, index))(jnp.asarray(indices))
    return _scanned(stacked(objects), keys, num_points)


def imagined_clouds(
    scenes: ClassSet,
    split: Split,
    framing: Framing,
    index: int,
    planner: Planner,
    num_poses: int = 4,
    num_points: int = 1024,
) -> LabelledClouds:
    """D u scan(theta; f_s) of one scene: D of one to four random views, every f_s seen from its own random poses.

    The samples are those of a planner that has seen D. The class is the true one, whatever a sample shows.
    """
    key = scene_key(1, split, index)
    return _imagined(scenes.scene(split, index, framing), key, planner, num_poses, num_points)


@eqx.filter_jit
def _scanned(objects: ClassObject, keys: Key[Array, " scenes"], num_points: int) -> LabelledClouds:
    def cloud_of(object_and_key):
        thing, key = object_and_key
        views, _, count, pixels = _partial_views(thing, key, MAX_VIEWS)
        cloud = farthest_point_subsample(joined_views(views), num_points)
        return LabelledClouds(cloud, thing.label, count, pixels, jnp.asarray(False), _on_cue(thing, cloud))

    return jax.lax.map(cloud_of, (objects, keys))


@eqx.filter_jit
def _imagined(
    thing: ClassObject, key: PRNGKeyArray, planner: Planner, num_poses: int, num_points: int
) -> LabelledClouds:
    key, sample_key, pose_key = jax.random.split(key, 3)
    views, poses, count, pixels = _partial_views(thing, key, MAX_VIEWS - 1)
    surfaces = planner.imagination.sample(evidence_after(planner, views, poses, Camera()), sample_key)
    seen = limit_capacity(joined_views(views), num_points)

    def of_sample(surface_and_key):
        surface, pose_key = surface_and_key
        scans = scan(surface, Camera(), random_poses(pose_key, num_poses, SENSOR_RADIUS))
        return jax.lax.map(lambda one: farthest_point_subsample(concatenate(seen, one), num_points), scans)

    keys = jax.random.split(pose_key, planner.imagination.num_samples)
    clouds = merged(jax.lax.map(of_sample, (surfaces, keys)))
    label, taken, most, imagined = (jnp.full(len(clouds.mask), value) for value in (thing.label, count, pixels, True))
    return LabelledClouds(clouds, label, taken, most, imagined, _on_cue(thing, clouds))


def _on_cue(thing: ClassObject, cloud: PointCloud) -> Bool[Array, "*batch points"]:
    return thing.on_cue(cloud.points, _NOISE) & cloud.mask


def _partial_views(
    thing: ClassObject, key: PRNGKeyArray, most: int
) -> tuple[PointCloud, Pose, Int[Array, ""], Int[Array, ""]]:
    """What one to `most` random views show, their poses, how many they are, and the most telling pixels of one."""
    pose_key, noise_key, count_key = jax.random.split(key, 3)
    poses = random_poses(pose_key, most, SENSOR_RADIUS)
    pixels, scans = scan_cue(thing, Camera(), poses)
    count = jax.random.randint(count_key, (), 1, most + 1)
    used = jnp.arange(most) < count
    return only(SensorNoise()(scans, noise_key), used), poses, count, jnp.max(jnp.where(used, pixels, 0))
