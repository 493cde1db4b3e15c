"""One method's episode in a simulated scene: its first view, its record, and the same views seen again."""

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


def sensor_before(surface: Surface, camera: Camera) -> Sensor:
    """A depth camera with the usual noise before a surface."""
    return lambda pose, key: observe_scene(surface, camera, pose, SensorNoise(), key)


def first_showing(
    enough: Callable[[PointCloud], bool], poses: Pose, sensor: Sensor, key: PRNGKeyArray, episode_key: PRNGKeyArray
) -> int | None:
    """Index of a random pose whose scan is enough; None if there is none.

    - `poses`: the candidates (n, ...).
    - `key`: of their order; `episode_key`: of the episode, for the noise of its first view.
    """
    *_, noise_key = view_keys(episode_key, 0)
    order = jax.random.permutation(key, poses.position.shape[0]).tolist()
    return next((one for one in order if enough(sensor(poses[one], noise_key))), None)


def episode_record(
    planner: Planner,
    sensor: Sensor,
    first: Pose,
    key: PRNGKeyArray,
    camera: Camera,
    views: int,
    follow: Callable[[Iterator[Step]], Record],
) -> Record:
    """The poses of an episode's views, for each step the value of its view and the seconds of its search, and what
    `follow` records of the steps; the episode ends after `views`, or where `follow` stops."""
    poses: list[dict[str, list]] = []
    searches: list[dict[str, float]] = []

    def noted() -> Iterator[Step]:
        for step in itertools.islice(Loop(planner, key, camera=camera).steps(sensor, first), views):
            pose, proposal = step.view.pose, step.view.proposal
            poses.append({"position": pose.position.tolist(), "rotation": pose.rotation.tolist()})
            if proposal is not None:
                searches.append({"value": float(proposal.value), "seconds": step.seconds})
            yield step

    # `follow` draws the steps, by which the lists are filled.
    followed = follow(noted())
    return {"views": poses, "steps": searches, **followed}


def seen_again(
    planner: Planner, sensor: Sensor, poses: Sequence[Pose], key: PRNGKeyArray, camera: Camera
) -> list[tuple[PointCloud, Observations]]:
    """Each scan of an episode and the observations after it, made again from its poses.

    - `planner`: any of the study's; observations depend on its capacity and what it carves alone.
    """
    views = [(pose, sensor(pose, view_keys(key, index)[2])) for index, pose in enumerate(poses)]
    return [(scan, after) for (_, scan), after in zip(views, planner.replay(views, camera), strict=True)]


def poses_of(run: Record) -> list[Pose]:
    """The poses of the views of a record."""
    arrays = [[np.asarray(view[name], np.float32) for name in ("rotation", "position")] for view in run["views"]]
    return [Pose(rotation, position) for rotation, position in arrays]
