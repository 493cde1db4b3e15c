"""Functions that run an episode, record it, and read its poses from the record."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.loop import Loop, Sensor, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.studies.engine.measures import Record


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

    The record holds the poses of the views, the value and the time (seconds) of each proposal, and the entries that
    `follow` returns. The episode ends after `views` views, or earlier if `follow` takes fewer steps from its iterator.

    - `first`: pose of the first view; `camera`: camera of the sensor.
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


def poses_of(run: Record) -> list[Pose]:
    """Return the poses of the views in a method's record."""
    arrays = [[np.asarray(view[name], np.float32) for name in ("rotation", "position")] for view in run["views"]]
    return [Pose(rotation, position) for rotation, position in arrays]
