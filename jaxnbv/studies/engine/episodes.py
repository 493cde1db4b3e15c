"""Functions that choose the first view of an episode, run and record it, and replay its views."""

import itertools
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.loop import Loop, Sensor, Step, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.scanning import SensorNoise, Surface
from jaxnbv.studies.engine.measures import Record


def simulated_sensor(surface: Surface, camera: Camera) -> Sensor:
    """Return a simulated depth camera that scans a surface with the default noise."""
    return lambda pose, key: observe_scene(surface, camera, pose, SensorNoise(), key)


def random_first_view(
    is_enough: Callable[[PointCloud], bool], poses: Pose, sensor: Sensor, key: PRNGKeyArray, episode_key: PRNGKeyArray
) -> int | None:
    """Return the index of a random pose whose scan satisfies `is_enough`, or None if there is none.

    - `poses`: the candidates, with one leading axis.
    - `key`: random key for the order in which the poses are tried.
    - `episode_key`: random key of the episode, from which the noise of the scans follows.
    """
    *_, noise_key = view_keys(episode_key, 0)
    order = jax.random.permutation(key, poses.position.shape[0]).tolist()
    return next((index for index in order if is_enough(sensor(poses[index], noise_key))), None)


def episode_record(
    planner: Planner,
    sensor: Sensor,
    first: Pose,
    key: PRNGKeyArray,
    camera: Camera,
    views: int,
    follow: Callable[[Iterator[Step]], Record],
) -> Record:
    """Run an episode and return its record.

    The record holds the poses of the views, the value and the time (seconds) of each proposal, and the record that
    `follow` returns. The episode ends after `views` views, or earlier if `follow` stops drawing steps.

    - `first`: pose of the first view; `camera`: camera of the sensor.
    - `follow`: function that draws the steps from an iterator and returns a record.
    """
    poses: list[dict[str, list]] = []
    searches: list[dict[str, float]] = []

    def recorded_steps() -> Iterator[Step]:
        for step in itertools.islice(Loop(planner, key, camera=camera).steps(sensor, first), views):
            pose, proposal = step.view.pose, step.view.proposal
            poses.append({"position": pose.position.tolist(), "rotation": pose.rotation.tolist()})
            if proposal is not None:
                searches.append({"value": float(proposal.value), "seconds": step.seconds})
            yield step

    # `follow` runs the steps, which fill the lists.
    record = follow(recorded_steps())
    return {"views": poses, "steps": searches, **record}


def replay_views(
    planner: Planner, sensor: Sensor, poses: Sequence[Pose], key: PRNGKeyArray, camera: Camera
) -> list[tuple[PointCloud, Observations]]:
    """Recompute each scan of an episode, and the observations after each scan, from the episode's poses.

    - `planner`: any planner of the study, because observations depend only on the planner's capacity and carving.
    - `key`: random key of the episode.
    """
    views = [(pose, sensor(pose, view_keys(key, index)[2])) for index, pose in enumerate(poses)]
    return [(scan, observations) for (_, scan), observations in zip(views, planner.replay(views, camera), strict=True)]


def poses_of(run: Record) -> list[Pose]:
    """Return the poses of the views in a method's record."""
    arrays = [[np.asarray(view[name], np.float32) for name in ("rotation", "position")] for view in run["views"]]
    return [Pose(rotation, position) for rotation, position in arrays]
