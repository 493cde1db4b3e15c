"""Training and test clouds of the shipped networks: scans from a few views, with true labels."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, Key, PRNGKeyArray
from tqdm import tqdm

from jaxnbv import Planner, PointCloud, Pose, SDFSurface, SensorNoise, look_at, scan
from jaxnbv.geometry.cloud import concatenate, farthest_point_subsample, limit_capacity
from jaxnbv.scanning.sensors import USUAL_SETTING, Setting
from jaxnbv.storage.files import make_folder, write_whole
from jaxnbv.studies.scenes import ClassObject, PartScene, Split
from jaxnbv.studies.scenes.class_object import scan_cue
from jaxnbv.studies.scenes.splits import scene_key

# Imagined clouds use scene numbers from here on, which no scanned cloud uses.
FIRST_IMAGINED = 100_000
# Maximum number of true views in a cloud, and before an imagined view.
MAX_VIEWS = 5
_SCENES_PER_FILE, _POSES = 100, 4
# Three standard deviations of the sensor's noise.
_NOISE = 3 * SensorNoise().points

SceneObject: TypeAlias = ClassObject | PartScene


class LabelledClouds(eqx.Module):
    """A batch of clouds, thinned by farthest point sampling, with labels.

    - `labels`: the objects' classes or categories.
    - `point_labels`: the true part that is nearest to each point; for classes, whether the point lies on the cue of the
      class, up to the sensor's noise.
    - `views`: number of true views in the cloud.
    - `cue_pixels`: the largest number of rays of a view that hit the cue of the class.
    - `imagined`: whether the cloud ends in a view of a posterior sample.
    """

    clouds: PointCloud
    labels: Int[Array, "*batch"]
    point_labels: Int[Array, "*batch points"] | Bool[Array, "*batch points"]
    views: Int[Array, "*batch"]
    cue_pixels: Int[Array, "*batch"]
    imagined: Bool[Array, "*batch"]


def concatenated(*parts: LabelledClouds) -> LabelledClouds:
    """Concatenate batches."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


class Source(NamedTuple):
    """Scenes of one kind. Their clouds are made once and stored in a folder.

    - `scene`: function from split and index to an object.
    - `planner`: the planner that samples surfaces for `imagined`.
    - `setting`: of the sensor.
    - `scale`: network units per scene unit.
    """

    folder: Path
    scene: Callable[[Split, int], SceneObject]
    planner: Planner
    num_points: int = 1024
    setting: Setting = USUAL_SETTING
    scale: float = 1.0

    def scanned(self, split: Split, count: int) -> LabelledClouds:
        """Clouds of true scans, one for each of `count` scenes, in the network's units."""

        def make(first: int) -> LabelledClouds:
            return scanned_clouds(
                self.scene, split, range(first, first + _SCENES_PER_FILE), self.num_points, self.setting
            )

        return self._load_or_make(f"scanned-{split}", range(0, count, _SCENES_PER_FILE), make)

    def imagined(self, split: Split, count: int) -> LabelledClouds:
        """Clouds that end in a scan of a posterior sample, four for each sample of `count` scenes."""

        def make(index: int) -> LabelledClouds:
            return imagined_clouds(self.scene, split, index, self.planner, self.num_points, self.setting)

        return self._load_or_make(f"imagined-{split}", range(FIRST_IMAGINED, FIRST_IMAGINED + count), make)

    def _load_or_make(self, name: str, steps: Iterable[int], make: Callable[[int], LabelledClouds]) -> LabelledClouds:
        """Clouds of all steps. Each step has its own file, so that an interrupted run makes only the missing ones."""
        folder = make_folder(self.folder / name)
        parts = []
        for step in tqdm(steps, name):
            path = folder / f"{step:06d}.npz"
            if not path.exists():
                leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(make(step))]
                write_whole(path, lambda file, leaves=leaves: np.savez(file, *leaves))
            with np.load(path) as saved:
                parts.append([saved[key] for key in saved.files])
        points, normals, mask, *rest = (jnp.asarray(np.concatenate(rows)) for rows in zip(*parts, strict=True))
        # On the host, where batches are picked.
        return jax.tree.map(np.asarray, LabelledClouds(PointCloud(self.scale * points, normals, mask), *rest))


def scanned_clouds(
    scene: Callable[[Split, int], SceneObject],
    split: Split,
    indices: Sequence[int],
    num_points: int = 1024,
    setting: Setting = USUAL_SETTING,
) -> LabelledClouds:
    """A cloud of each scene from one to five random views with the sensor's noise, in scene units."""
    targets = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(scene(split, index) for index in indices))
    keys = jax.vmap(lambda index: scene_key(1, split, index))(jnp.asarray(indices))
    return _scanned(targets, keys, num_points, setting)


def imagined_clouds(
    scene: Callable[[Split, int], SceneObject],
    split: Split,
    index: int,
    planner: Planner,
    num_points: int = 1024,
    setting: Setting = USUAL_SETTING,
) -> LabelledClouds:
    """D u scan(theta; f_s) of one scene, where D is from one to four random views, with four random poses for each f_s.

    The samples f_s are a planner's, given D. Labels are those of the true scene, even where a sample differs.
    """
    return _imagined(scene(split, index), scene_key(1, split, index), planner, num_points, setting)


def random_poses(key: PRNGKeyArray, count: int, radius: float) -> Pose:
    """Poses uniform on a sphere around the scene's centre, looking at it."""
    direction = jax.random.normal(key, (count, 3))
    return look_at(radius * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True))


def joined_views(views: PointCloud) -> PointCloud:
    """The points of all views (v, rays) as one cloud."""
    return PointCloud(views.points.reshape(-1, 3), views.normals.reshape(-1, 3), views.mask.reshape(-1))


@eqx.filter_jit
def _scanned(targets: SceneObject, keys: Key[Array, " scenes"], num_points: int, setting: Setting) -> LabelledClouds:
    def cloud_of(target_and_key):
        target, key = target_and_key
        views, _, count, pixels = _partial_views(target, key, MAX_VIEWS, setting)
        cloud = farthest_point_subsample(joined_views(views), num_points)
        return LabelledClouds(cloud, _label(target), _point_labels(target, cloud), count, pixels, jnp.asarray(False))

    return jax.lax.map(cloud_of, (targets, keys))


@eqx.filter_jit
def _imagined(
    target: SceneObject, key: PRNGKeyArray, planner: Planner, num_points: int, setting: Setting
) -> LabelledClouds:
    key, sample_key, pose_key = jax.random.split(key, 3)
    views, poses, count, pixels = _partial_views(target, key, MAX_VIEWS - 1, setting)
    *_, observations = planner.replay(((poses[i], views[i]) for i in range(MAX_VIEWS - 1)), setting.camera)
    surfaces = planner.sampler.sample(observations, sample_key)
    cloud = limit_capacity(joined_views(views), num_points)

    def of_sample(surface_and_key):
        surface, pose_key = surface_and_key
        scans = scan(surface, setting.camera, random_poses(pose_key, _POSES, setting.radius))
        return jax.lax.map(lambda view_scan: farthest_point_subsample(concatenate(cloud, view_scan), num_points), scans)

    keys = jax.random.split(pose_key, planner.sampler.num_samples)
    clouds = jax.lax.map(of_sample, (surfaces, keys))
    clouds = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), clouds)
    label, count, pixels, imagined = (
        jnp.full(len(clouds.mask), value) for value in (_label(target), count, pixels, True)
    )
    return LabelledClouds(clouds, label, _point_labels(target, clouds), count, pixels, imagined)


def _partial_views(
    target: SceneObject, key: PRNGKeyArray, max_views: int, setting: Setting
) -> tuple[PointCloud, Pose, Int[Array, ""], Int[Array, ""]]:
    """Scans from one to `max_views` random views, further views masked; the poses, the number of views, and the
    largest number of pixels on the cue in a view."""
    pose_key, noise_key, count_key = jax.random.split(key, 3)
    poses = random_poses(pose_key, max_views, setting.radius)
    if isinstance(target, PartScene):
        scans = scan(SDFSurface(target.solid), setting.camera, poses)
        pixels = scans.count
    else:
        pixels, scans = scan_cue(target, setting.camera, poses)
    count = jax.random.randint(count_key, (), 1, max_views + 1)
    is_used = jnp.arange(max_views) < count
    views = SensorNoise()(scans, noise_key)
    views = PointCloud(views.points, views.normals, views.mask & is_used[:, None], views.missed & is_used[:, None])
    return views, poses, count, jnp.max(jnp.where(is_used, pixels, 0))


def _label(target: SceneObject) -> Int[Array, ""]:
    return target.category if isinstance(target, PartScene) else target.label


def _point_labels(target: SceneObject, cloud: PointCloud) -> Any:
    if isinstance(target, PartScene):
        return target.solid.part_labels(cloud.points)
    return target.on_cue(cloud.points, _NOISE) & cloud.mask
