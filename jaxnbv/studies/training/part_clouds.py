"""Clouds that a part segmenter is trained and tested on."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, Key, PRNGKeyArray

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import SDFSurface, SensorNoise, scan
from jaxnbv.scanning.sensors import PART_SETTING
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.studies.scenes.labelled import LabelledSolid
from jaxnbv.studies.scenes.splits import scene_key
from jaxnbv.studies.training.views import evidence_after, joined_views, merged, only, random_poses, stacked

MAX_VIEWS = 6
_CLOUDS_A_SCENE = 3


class LabelledPartClouds(eqx.Module):
    """A batch of clouds with a part for every point.

    - `clouds`: in scene units, thinned by farthest point sampling.
    - `labels`: parts of ShapeNet-part, of 50; of masked rows they mean nothing.
    - `categories`: indices of `CATEGORIES`.
    """

    clouds: PointCloud
    labels: Int[Array, "*batch points"]
    categories: Int[Array, "*batch"]


def scanned_part_clouds(
    split: Split, indices: Sequence[int], num_points: int = 1024, camera: Camera = PART_SETTING.camera
) -> LabelledPartClouds:
    """Three clouds of each scene, of one to six of the same six random views, with the sensor's noise."""
    return merged(_scanned(_keyed(split, indices), num_points, camera))


def imagined_part_clouds(
    split: Split,
    indices: Sequence[int],
    planner: Planner,
    num_poses: int = 4,
    num_points: int = 1024,
    camera: Camera = PART_SETTING.camera,
) -> LabelledPartClouds:
    """D u scan(theta; f_s) of each scene: D of one to five views, every sample f_s seen from random poses of its own.

    The samples are those of a planner that has seen D. A point that was imagined has the label of the part that is
    nearest to it in truth.
    """
    return merged(_imagined(_keyed(split, indices), planner, num_poses, num_points, camera))


# Solids, their categories, and a key for each.
_Scenes = tuple[LabelledSolid, Int[Array, " scenes"], Key[Array, " scenes"]]


def _keyed(split: Split, indices: Sequence[int]) -> _Scenes:
    scenes = stacked([part_scene(split, index) for index in indices])
    keys = jax.vmap(lambda index: scene_key(5, split, index))(jnp.asarray(indices))
    return scenes.solid, scenes.category, keys


@eqx.filter_jit
def _scanned(scenes: _Scenes, num_points: int, camera: Camera) -> LabelledPartClouds:
    def of_scene(scene):
        solid, category, key = scene
        view_key, *keys = jax.random.split(key, 1 + _CLOUDS_A_SCENE)
        views, _, labels = _views(solid, view_key, camera)
        clouds = [_thin(joined_views(_some(views, key, MAX_VIEWS)), labels.reshape(-1), num_points) for key in keys]
        cloud, labels = stacked(clouds)
        return LabelledPartClouds(cloud, labels, jnp.full(_CLOUDS_A_SCENE, category))

    return jax.lax.map(of_scene, scenes)


@eqx.filter_jit
def _imagined(scenes: _Scenes, planner: Planner, num_poses: int, num_points: int, camera: Camera) -> LabelledPartClouds:
    def of_scene(scene):
        solid, category, key = scene
        view_key, some_key, sample_key, pose_key = jax.random.split(key, 4)
        views, poses, labels = _views(solid, view_key, camera)
        views = _some(views, some_key, MAX_VIEWS - 1)
        surfaces = planner.imagination.sample(evidence_after(planner, views, poses, camera), sample_key)
        cloud, labels = _thin(joined_views(views), labels.reshape(-1), num_points)

        def of_sample(surface_and_key):
            surface, key = surface_and_key
            scans = scan(surface, camera, random_poses(key, num_poses, PART_SETTING.radius))

            def joined(seen):
                both = concatenate(cloud, seen)
                return _thin(both, jnp.concatenate([labels, solid.label(seen.points)]), num_points)

            clouds, points_labels = jax.lax.map(joined, scans)
            return LabelledPartClouds(clouds, points_labels, jnp.full(num_poses, category))

        return merged(jax.lax.map(of_sample, (surfaces, jax.random.split(pose_key, planner.imagination.num_samples))))

    return jax.lax.map(of_scene, scenes)


def _thin(cloud: PointCloud, labels: Int[Array, " n"], count: int) -> tuple[PointCloud, Int[Array, " count"]]:
    """The rows that `farthest_point_subsample` keeps, with their labels."""
    index = farthest_point_indices(cloud.points, cloud.mask, count)
    kept = jnp.arange(count) < cloud.count
    thinned = jax.tree.map(lambda leaf: jnp.where(kept.reshape(-1, *[1] * (leaf.ndim - 1)), leaf[index], 0), cloud)
    return PointCloud(thinned.points, thinned.normals, kept), labels[index]


def _views(
    solid: LabelledSolid, key: PRNGKeyArray, camera: Camera
) -> tuple[PointCloud, Pose, Int[Array, "views rays"]]:
    """What random views show, with noise, their poses, and the true part of every point."""
    pose_key, noise_key = jax.random.split(key)
    poses = random_poses(pose_key, MAX_VIEWS, PART_SETTING.radius)
    scans = scan(SDFSurface(solid), camera, poses)
    return SensorNoise()(scans, noise_key), poses, solid.label(scans.points)


def _some(views: PointCloud, key: PRNGKeyArray, most: int) -> PointCloud:
    """One to `most` of the views, drawn at random; the rows of the others are masked."""
    count_key, order_key = jax.random.split(key)
    used = jax.random.permutation(order_key, MAX_VIEWS) < jax.random.randint(count_key, (), 1, most + 1)
    return only(views, used)
