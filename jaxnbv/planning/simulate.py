"""Simulated episodes, in which the sensor scans a known surface."""

import dataclasses
import itertools
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

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
from jaxnbv.programs import program
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
    """Simulate an episode: scan a known surface from `first`, then from the planner's proposals.

    View i does not depend on `views`. An interrupted run with a folder continues after its last view. On a CPU with the
    same package versions, its result equals that of an uninterrupted run bit for bit. On a GPU the bits may differ,
    because the order of sums varies. You can continue a run with a different stop rule, which is checked after the last
    stored view.

    - `scene`: the true surface, which is a `Surface`, a solid or a trimesh mesh.
    - `first`: pose of the first view, in scene coordinates.
    - `views`: total number of views, unless the stop rule ends the episode earlier.
    - `key`: random key. The random numbers of view i depend only on `key` and i.
    - `folder`: folder that stores every finished view.
    - `progress`: whether to show the stages on a progress bar.
    - `until`: stop rule, for example `Sure(0.95) | Budget(seconds=60)`.
    - `each`: function that is called with the step of every view, including stored views.

    **Raises:** `ValueError` if `views` is less than 1 or greater than the planner's `max_views`, if the first view sees
    nothing, or if the folder belongs to a run with different arguments or already holds more views.
    """
    check_num_views(planner, views)
    check_key(key)
    require(first.position.ndim == 1, "the first pose is a batch of poses: give one, poses[0] say")
    surface = as_surface(scene)
    episode = Episode(planner, surface, noise, first, key)
    store = None if folder is None else episode.open(folder)
    with store.writing() if store else nullcontext():
        stored_views = read_views(store) if store else []
        count = len(stored_views)
        require(
            count <= views,
            f"asked for {views} views but {folder} already holds {count}: ask for more, or choose another folder",
        )
        with progress_bar(total=views * len(STAGES), enabled=progress) as bar:

            def on_stage(stage: str) -> None:
                index = len(loop.views)
                bar.set_description(f"view {index + 1}/{views}, {stage}")
                bar.update(index * len(STAGES) + STAGES.index(stage) - bar.n)

            def sensor(pose: Pose, key: PRNGKeyArray) -> PointCloud:
                return observe_scene(surface, planner.camera, pose, noise, key, planner.obstacles)

            loop = Loop(planner, key, until, on_stage=on_stage)
            for step in itertools.islice(loop.steps(sensor, first, stored_views), views):
                index = len(loop.views) - 1
                if store and index >= count:
                    store.write("view", index, pose=step.view.pose, scan=step.view.scan, proposal=step.view.proposal)
                if each is not None:
                    each(step)
                # A posterior may be large, so it is freed before the next step computes a new one.
                del step
            bar.update(bar.total - bar.n)
        reason = loop.stop_reason if len(loop.views) < views else None
        episode = dataclasses.replace(episode, views=loop.views, stop_reason=reason)
        if store:
            episode.write_end(store)
    return episode


def check_num_views(planner: Planner, views: int) -> None:
    """Raise `ValueError` unless `views` is at least one and at most the planner's `max_views`."""
    require(views >= 1, f"asked for {views} views; ask for at least one")
    require(
        views <= planner.max_views,
        f"asked for {views} views but the planner has room for {planner.max_views}: raise Planner(max_views=...)",
    )


def observe_scene(
    scene: Surface, camera: Camera, pose: Pose, noise: Noise, key: PRNGKeyArray, obstacles: Obstacles | None = None
) -> PointCloud:
    """Return a noisy scan of the true surface, which obstacles may hide. It is compiled if `scene.in_jit`."""
    barrier = None if obstacles is None else _barrier(obstacles, camera, pose)
    observe = _noisy_scan_in_jit if scene.in_jit else _noisy_scan
    return observe(scene, camera, pose, barrier, noise, key)


def _noisy_scan(
    scene: Surface, camera: Camera, pose: Pose, barrier: Float[Array, " rays"] | None, noise: Noise, key: PRNGKeyArray
) -> PointCloud:
    return noise(scan(scene, camera, pose, barrier), key, camera, pose)


_noisy_scan_in_jit, _barrier = program(_noisy_scan), program(barrier_of)
