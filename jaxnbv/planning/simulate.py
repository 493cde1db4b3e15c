"""The simulated episode: the loop at a sensor that scans a known surface."""

import dataclasses
import itertools
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import equinox as eqx
import trimesh
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import check_key, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode import Episode, read_views
from jaxnbv.planning.loop import STAGES, Loop, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import StopRule
from jaxnbv.progress import progress_bar
from jaxnbv.scanning import Noise, Obstacles, SensorNoise, Surface, as_surface, barrier_of, scan
from jaxnbv.scanning.sdf import SignedDistance


@checked
def simulate(
    planner: Planner,
    scene: Surface | SignedDistance | trimesh.Trimesh | trimesh.Scene,
    first: Pose,
    views: int,
    key: PRNGKeyArray,
    noise: Noise = SensorNoise(),
    folder: str | Path | None = None,
    progress: bool = True,
    until: StopRule | None = None,
    each: Callable[[Step], None] | None = None,
) -> Episode:
    """Scan a known surface, solid or mesh of trimesh's from `first`, then from the views that the planner asks for:
    `views` in all, or as many as it takes `until` a rule of stopping ends it, `Sure(0.95) | Budget(seconds=60)` say.

    View i depends on the key and i alone, not on how many follow. With `folder`, every finished view is written there;
    a run that was interrupted goes on after the last of them and, on a CPU with the same versions, ends with the same
    bits as one that was not. (A GPU may add in another order from run to run.) The rule is asked after the last view
    that is there, so a folder can be continued with another one.

    - `each`: is called with the step to every view once it is done, those that the folder holds included.

    **Raises:** `ValueError` if `views` < 1 or more than the planner has room for, if the first view sees nothing, or
    if the folder belongs to another configuration or holds more views already.
    """
    require(views >= 1, f"asked for {views} views; ask for at least one")
    require(
        views <= planner.max_views,
        f"asked for {views} views but the planner has room for {planner.max_views}: raise Planner(max_views=...)",
    )
    check_key(key)
    require(first.position.ndim == 1, "the first pose is a batch of poses: give one, poses[0] say")
    surface = as_surface(scene)
    episode = Episode(planner, surface, noise, first, key)
    store = None if folder is None else episode.open(folder)
    with store.writing() if store else nullcontext():
        stored = read_views(store) if store else []
        require(
            len(stored) <= views,
            f"asked for {views} views but {folder} already holds {len(stored)}: ask for more, or choose another folder",
        )
        with progress_bar(total=views * len(STAGES), wanted=progress) as bar:

            def begin(stage: str) -> None:
                index = len(loop.views)
                bar.set_description(f"view {index + 1}/{views}, {stage}")
                bar.update(index * len(STAGES) + STAGES.index(stage) - bar.n)

            def sensor(pose: Pose, key: PRNGKeyArray) -> PointCloud:
                return observe_scene(surface, planner.camera, pose, noise, key, planner.obstacles)

            loop = Loop(planner, key, until, begin=begin)
            for step in itertools.islice(loop.steps(sensor, first, stored), views):
                index = len(loop.views) - 1
                if store and index >= len(stored):
                    store.write("view", index, pose=step.view.pose, scan=step.view.scan, proposal=step.view.proposal)
                if each is not None:
                    each(step)
                # Its posterior may be large, and is not to be held beside that of the next step.
                del step
            bar.update(bar.total - bar.n)
        stopped = loop.stopped if len(loop.views) < views else None
        episode = dataclasses.replace(episode, views=loop.views, stopped=stopped)
        if store:
            episode.write_end(store)
    return episode


def observe_scene(
    scene: Surface,
    camera: Camera,
    pose: Pose,
    noise: Noise,
    key: PRNGKeyArray,
    obstacles: Obstacles | None = None,
) -> PointCloud:
    """A noisy scan of the true surface, past obstacles; compiled where the surface allows it."""
    barrier = None if obstacles is None else _barrier(obstacles, camera, pose)
    observe = _noisy_scan_in_jit if scene.in_jit else _noisy_scan
    return observe(scene, camera, pose, barrier, noise, key)


def _noisy_scan(
    scene: Surface,
    camera: Camera,
    pose: Pose,
    barrier: Float[Array, " rays"] | None,
    noise: Noise,
    key: PRNGKeyArray,
) -> PointCloud:
    return noise(scan(scene, camera, pose, barrier), key, camera, pose)


_noisy_scan_in_jit, _barrier = eqx.filter_jit(_noisy_scan), eqx.filter_jit(barrier_of)
