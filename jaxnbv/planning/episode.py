"""The simulated episode: scan, ask for the next view, scan again."""

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import check_key, check_type, checked, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import Watch
from jaxnbv.progress import progress_bar
from jaxnbv.scanning import GridSurface, Noise, Obstacles, SensorNoise, Surface, as_surface, scan
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.search import Proposal
from jaxnbv.storage import RunFolder
from jaxnbv.surfaces import SurfacePosterior
from jaxnbv.tasks import Coverage, StopRule


class View(eqx.Module):
    """One view of an episode.

    - `pose`: where the sensor was.
    - `scan`: what it saw, noise included; one row a pixel.
    - `cloud`: D after this view.
    - `proposal`: what the search looked at; None for the first view, which was given.
    - `camera`: which took it, in scene units.
    """

    pose: Pose
    scan: PointCloud
    cloud: PointCloud
    proposal: Proposal | None
    camera: Camera


class Episode(eqx.Module):
    """Views that a planner chose of a scene, and what they depend on.

    - `scene`, `noise`: None where a real sensor took the views.
    - `stopped`: why there are not as many views as were asked for; None where there are.
    """

    planner: Planner
    scene: Surface | None
    noise: Noise | None
    first: Pose
    key: PRNGKeyArray
    views: tuple[View, ...]
    stopped: str | None = None

    @property
    def cloud(self) -> PointCloud:
        """D after the last view, in scene coordinates."""
        return self.views[-1].cloud

    def observations(self) -> Iterator[Observations]:
        """What the planner knows after each view, made again from the scans."""
        return self.planner.replay((view.pose, view.scan, view.camera) for view in self.views)

    def observations_after(self, views: int) -> Observations:
        """What the planner knows after so many of the views.

        **Raises:** `ValueError` unless there are so many, and at least one.
        """
        check_type(views, int, "the number of views")
        require(1 <= views <= len(self.views), f"asked for {views} of {len(self.views)} views; ask for one at least")
        return next(itertools.islice(self.observations(), views - 1, None))

    @classmethod
    def load(cls, path: str | Path) -> "Episode":
        """The episode of a folder, which says what camera was planned for but not how: its planner has this camera and
        the usual surfaces, for what is to be drawn.

        **Raises:** `ValueError` if the folder holds no episode, or one without a view.
        """
        config = RunFolder.config_of(path, "episode")
        views = read_views(RunFolder(path, "episode", config))
        require(len(views) > 0, f"{path} holds no view yet")
        planner = Planner(Coverage(), camera=config["planner"].camera)
        after = planner.replay((pose, scan) for pose, scan, _ in views)
        shown = tuple(
            View(pose, scan, observations.cloud, proposal, planner.camera)
            for (pose, scan, proposal), observations in zip(views, after, strict=True)
        )
        return cls(planner, None, None, views[0][0], jax.random.key(0), shown)

    def save(self, path: str | Path) -> None:
        """Write the episode to a folder (see `jaxnbv.storage` for its files); `simulate` can continue from it.

        **Raises:** `ValueError` if the folder holds an episode of another configuration or a longer one, or other
        files.
        """
        folder = RunFolder(path, "episode", _config(self.planner, self.scene, self.noise, self.first, self.key))
        with folder.writing():
            held = folder.count("view")
            require(
                held <= len(self.views),
                f"{path} already holds {held} views of this episode, which has {len(self.views)}: "
                "choose another folder",
            )
            for index, view in enumerate(self.views):
                folder.write("view", index, pose=view.pose, scan=view.scan, proposal=view.proposal)
            folder.write_cloud(self.cloud)


def read_views(folder: RunFolder) -> list[tuple[Pose, PointCloud, Proposal | None]]:
    """Pose, scan and proposal of every view that a folder holds.

    **Raises:** `ValueError` if one is damaged, or missing between others.
    """
    views = (folder.read("view", index) for index in range(folder.count("view")))
    return [(view["pose"], view["scan"], view.get("proposal")) for view in views]


def _config(planner: Planner, scene: Surface | None, noise: Noise | None, first: Pose, key: PRNGKeyArray) -> dict:
    return {"planner": planner, "scene": scene, "noise": noise, "first": first, "key": key}


@checked
def simulate(
    planner: Planner,
    scene: Surface | SignedDistance,
    first: Pose,
    views: int,
    key: PRNGKeyArray,
    noise: Noise = SensorNoise(),
    folder: str | Path | None = None,
    progress: bool = True,
    until: StopRule | None = None,
    each: Callable[["Step"], None] | None = None,
) -> Episode:
    """Scan a known surface, or solid, from `first`, then from the views that the planner asks for: `views` in all, or
    as many as it takes `until` a rule of stopping ends it, `Sure(0.95) | Budget(seconds=60)` say.

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
    scene = as_surface(scene)
    store = None if folder is None else RunFolder(folder, "episode", _config(planner, scene, noise, first, key))
    with store.writing() if store else nullcontext():
        done = read_views(store) if store else []
        require(
            len(done) <= views,
            f"asked for {views} views but {folder} already holds {len(done)}: ask for more, or choose another folder",
        )
        finished: list[View] = []
        with progress_bar(total=views * len(STAGES), wanted=progress) as bar:

            def begin(index: int, stage: str) -> None:
                bar.set_description(f"view {index + 1}/{views}, {stage}")
                bar.update(index * len(STAGES) + STAGES.index(stage) - bar.n)

            def sensor(pose: Pose, key: PRNGKeyArray) -> PointCloud:
                return observe_scene(scene, planner.camera, pose, noise, key, planner.sampler.obstacles)

            watch = None if until is None else Watch(until, planner.acquisition)
            episode = steps(planner, sensor, first, key, done=done, begin=begin, watch=watch)
            for step in itertools.islice(episode, views):
                index, view = len(finished), step.view
                finished.append(view)
                if store and index >= len(done):
                    store.write("view", index, pose=view.pose, scan=view.scan, proposal=view.proposal)
                if each is not None:
                    each(step)
                # Its posterior may be large, and is not to be held beside that of the next step.
                del step
            stopped = watch.reason if watch and len(finished) < views else None
            bar.update(bar.total - bar.n)
        if store:
            store.write_cloud(finished[-1].cloud)
    return Episode(planner, scene, noise, first, key, tuple(finished), stopped=stopped)


# What a sensor sees from a pose; the key is of its noise, for which a real sensor has no use.
Sensor: TypeAlias = Callable[[Pose, PRNGKeyArray], PointCloud]
STAGES = ("sampling surfaces", "searching", "scanning")


class Basis(NamedTuple):
    """What a view was chosen by: the observations before it, the posterior given that, and the step's samples."""

    observations: Observations
    posterior: SurfacePosterior
    surfaces: GridSurface

    @classmethod
    def of(cls, planner: Planner, observations: Observations, key: PRNGKeyArray) -> "Basis":
        """Of the next step, once it is computed."""
        posterior = planner.sampler.posterior(observations)
        surfaces = planner.sampler.sample(observations, key, posterior)
        return cls(observations, posterior, jax.block_until_ready(surfaces))


class Step(NamedTuple):
    """How an episode came to a view, and what the planner knows after it.

    - `basis`: None for a view that was given or known already, and where the search looks at no samples.
    - `seconds`: of the search; zero for a view that was given.
    """

    view: View
    observations: Observations
    basis: Basis | None
    seconds: float


def steps(
    planner: Planner,
    sensor: Sensor,
    first: Pose,
    key: PRNGKeyArray,
    camera: Camera | None = None,
    done: Iterable[tuple[Pose, PointCloud, Proposal | None]] = (),
    begin: Callable[[int, str], None] = lambda index, stage: None,
    watch: Watch | None = None,
) -> Iterator[Step]:
    """Views from `first` on, each where the planner asks for it, for as long as more are wanted and it has room.

    View i depends on the key and i alone: planners that differ in their search or their acquisition are compared under
    the same sensor noise, and under the same prior samples at the same view.

    - `camera`: of the sensor, by default the planner's; one of more rays than are imagined saves time.
    - `done`: views that are known already, in their order; they are not asked for again.
    - `begin`: is called with the index of a view and which of `STAGES` of it begins.
    - `watch`: ends them, by its rule.

    **Raises:** `ValueError` as `Planner.init`, `propose` and `observe` do; among others when every candidate has been
    visited.
    """
    known, observations = iter(done), None
    poses: list[Pose] = []
    for index in range(planner.max_views):
        sample_key, search_key, noise_key = view_keys(key, index)
        basis, seconds = None, 0.0
        if (taken := next(known, None)) is not None:
            pose, seen, proposal = taken
        else:
            pose, proposal = first, None
            if observations is not None:
                if watch and watch.ends(planner, observations, poses, sample_key):
                    return
                if planner.search.uses_samples:
                    begin(index, STAGES[0])
                    basis = Basis.of(planner, observations, sample_key)
                begin(index, STAGES[1])
                start = time.perf_counter()
                sampled = None if basis is None else basis.surfaces
                proposal = jax.block_until_ready(planner.choose(observations, sampled, search_key))
                pose, seconds = proposal.pose, time.perf_counter() - start
                if watch and watch.ends(planner, observations, poses, sample_key, proposal):
                    return
            begin(index, STAGES[2])
            seen = sensor(pose, noise_key)
        if observations is None:
            observations = planner.init(pose, seen, camera)
        else:
            observations = planner.observe(observations, pose, seen, camera)
        poses.append(pose)
        yield Step(
            View(pose, seen, observations.cloud, proposal, camera or planner.camera), observations, basis, seconds
        )


def view_keys(key: PRNGKeyArray, index: int) -> tuple[PRNGKeyArray, PRNGKeyArray, PRNGKeyArray]:
    """Keys of view `index` (from 0) of an episode: of its posterior samples, its search and its sensor's noise."""
    step_key, noise_key = jax.random.split(jax.random.fold_in(key, index))
    sample_key, search_key = jax.random.split(step_key)
    return sample_key, search_key, noise_key


def observe_scene(
    scene: Surface,
    camera: Camera,
    pose: Pose,
    noise: Noise,
    key: PRNGKeyArray,
    obstacles: Obstacles | None = None,
) -> PointCloud:
    """A noisy scan of the true surface, past what stands around it; compiled where the surface allows it."""
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


_noisy_scan_in_jit, _barrier = eqx.filter_jit(_noisy_scan), eqx.filter_jit(Obstacles.barrier)
