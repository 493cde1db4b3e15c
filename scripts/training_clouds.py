"""Clouds that the shipped networks are trained and tested on: what a few views show, and what is true of it."""

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

# Scenes whose posterior is sampled come from numbers that no scanned cloud uses.
FIRST_IMAGINED = 100_000
# Of true views, and of those before an imagined one.
MOST_VIEWS = 5
_AT_ONCE, _POSES = 100, 4
# Three standard deviations of the sensor's.
_NOISE = 3 * SensorNoise().points

Thing: TypeAlias = ClassObject | PartScene


class LabelledClouds(eqx.Module):
    """A batch of clouds, thinned by farthest point sampling, and what a network should say of them.

    - `labels`: the objects' classes or categories.
    - `point_labels`: the part that is nearest to each point in truth; or, of an object of a class, whether the point
      lies on the cue of the class, up to the sensor's noise.
    - `views`: how many true views the cloud is of.
    - `cue_pixels`: the most rays of one of these views that hit the cue of the class.
    - `imagined`: whether a view of a posterior sample was added to them.
    """

    clouds: PointCloud
    labels: Int[Array, "*batch"]
    point_labels: Int[Array, "*batch points"] | Bool[Array, "*batch points"]
    views: Int[Array, "*batch"]
    cue_pixels: Int[Array, "*batch"]
    imagined: Bool[Array, "*batch"]


def concatenated(*parts: LabelledClouds) -> LabelledClouds:
    """Several batches as one."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


class Source(NamedTuple):
    """Scenes of one kind, whose clouds are made once and kept in a folder.

    - `scene`: an object, of a split and an index.
    - `planner`: what imagines the views of `imagined`.
    - `setting`: the sensor's.
    - `scale`: network units per scene unit.
    """

    folder: Path
    scene: Callable[[Split, int], Thing]
    planner: Planner
    num_points: int = 1024
    setting: Setting = USUAL_SETTING
    scale: float = 1.0

    def scanned(self, split: Split, count: int) -> LabelledClouds:
        """Clouds of true scans, one of each of `count` scenes, in the network's units."""

        def make(first: int) -> LabelledClouds:
            return scanned_clouds(self.scene, split, range(first, first + _AT_ONCE), self.num_points, self.setting)

        return self._kept(f"scanned-{split}", range(0, count, _AT_ONCE), make)

    def imagined(self, split: Split, count: int) -> LabelledClouds:
        """Clouds that end in a scan of a posterior sample, four of each sample of `count` scenes."""

        def make(index: int) -> LabelledClouds:
            return imagined_clouds(self.scene, split, index, self.planner, self.num_points, self.setting)

        return self._kept(f"imagined-{split}", range(FIRST_IMAGINED, FIRST_IMAGINED + count), make)

    def _kept(self, name: str, steps: Iterable[int], make: Callable[[int], LabelledClouds]) -> LabelledClouds:
        """What all steps give; each has a file of its own, so that a run that was interrupted makes those missing."""
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
        # What is picked from them is picked on the host.
        return jax.tree.map(np.asarray, LabelledClouds(PointCloud(self.scale * points, normals, mask), *rest))


def scanned_clouds(
    scene: Callable[[Split, int], Thing],
    split: Split,
    indices: Sequence[int],
    num_points: int = 1024,
    setting: Setting = USUAL_SETTING,
) -> LabelledClouds:
    """A cloud of each scene, of one to five random views with the sensor's noise, in scene units."""
    things = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(scene(split, index) for index in indices))
    keys = jax.vmap(lambda index: scene_key(1, split, index))(jnp.asarray(indices))
    return _scanned(things, keys, num_points, setting)


def imagined_clouds(
    scene: Callable[[Split, int], Thing],
    split: Split,
    index: int,
    planner: Planner,
    num_points: int = 1024,
    setting: Setting = USUAL_SETTING,
) -> LabelledClouds:
    """D u scan(theta; f_s) of one scene: D of one to four random views, every f_s seen from its own four random poses.

    The samples are those of a planner that has seen D. What is true is that of the scene, whatever a sample shows.
    """
    return _imagined(scene(split, index), scene_key(1, split, index), planner, num_points, setting)


def random_poses(key: PRNGKeyArray, count: int, radius: float) -> Pose:
    """Uniform on a sphere about the scene's middle, looking at it."""
    direction = jax.random.normal(key, (count, 3))
    return look_at(radius * direction / jnp.linalg.norm(direction, axis=-1, keepdims=True))


def joined_views(views: PointCloud) -> PointCloud:
    """The points of all views (v, rays) as one cloud."""
    return PointCloud(views.points.reshape(-1, 3), views.normals.reshape(-1, 3), views.mask.reshape(-1))


@eqx.filter_jit
def _scanned(things: Thing, keys: Key[Array, " scenes"], num_points: int, setting: Setting) -> LabelledClouds:
    def cloud_of(thing_and_key):
        thing, key = thing_and_key
        views, _, count, pixels = _partial_views(thing, key, MOST_VIEWS, setting)
        cloud = farthest_point_subsample(joined_views(views), num_points)
        return LabelledClouds(cloud, _label(thing), _point_labels(thing, cloud), count, pixels, jnp.asarray(False))

    return jax.lax.map(cloud_of, (things, keys))


@eqx.filter_jit
def _imagined(thing: Thing, key: PRNGKeyArray, planner: Planner, num_points: int, setting: Setting) -> LabelledClouds:
    key, sample_key, pose_key = jax.random.split(key, 3)
    views, poses, count, pixels = _partial_views(thing, key, MOST_VIEWS - 1, setting)
    *_, observations = planner.replay(((poses[i], views[i]) for i in range(MOST_VIEWS - 1)), setting.camera)
    surfaces = planner.sampler.sample(observations, sample_key)
    seen = limit_capacity(joined_views(views), num_points)

    def of_sample(surface_and_key):
        surface, pose_key = surface_and_key
        scans = scan(surface, setting.camera, random_poses(pose_key, _POSES, setting.radius))
        return jax.lax.map(lambda one: farthest_point_subsample(concatenate(seen, one), num_points), scans)

    keys = jax.random.split(pose_key, planner.sampler.num_samples)
    clouds = jax.lax.map(of_sample, (surfaces, keys))
    clouds = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), clouds)
    label, count, pixels, imagined = (
        jnp.full(len(clouds.mask), value) for value in (_label(thing), count, pixels, True)
    )
    return LabelledClouds(clouds, label, _point_labels(thing, clouds), count, pixels, imagined)


def _partial_views(
    thing: Thing, key: PRNGKeyArray, most: int, setting: Setting
) -> tuple[PointCloud, Pose, Int[Array, ""], Int[Array, ""]]:
    """What one to `most` random views show, the rays of the others masked; their poses, how many they are, and the most
    telling pixels of one."""
    pose_key, noise_key, count_key = jax.random.split(key, 3)
    poses = random_poses(pose_key, most, setting.radius)
    if isinstance(thing, PartScene):
        scans = scan(SDFSurface(thing.solid), setting.camera, poses)
        pixels = scans.count
    else:
        pixels, scans = scan_cue(thing, setting.camera, poses)
    count = jax.random.randint(count_key, (), 1, most + 1)
    used = jnp.arange(most) < count
    views = SensorNoise()(scans, noise_key)
    views = PointCloud(views.points, views.normals, views.mask & used[:, None], views.missed & used[:, None])
    return views, poses, count, jnp.max(jnp.where(used, pixels, 0))


def _label(thing: Thing) -> Int[Array, ""]:
    return thing.category if isinstance(thing, PartScene) else thing.label


def _point_labels(thing: Thing, cloud: PointCloud) -> Any:
    if isinstance(thing, PartScene):
        return thing.solid.part_labels(cloud.points)
    return thing.on_cue(cloud.points, _NOISE) & cloud.mask
