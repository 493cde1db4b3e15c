"""Points and cameras to draw after a view, for still pictures, 3-D figures and the live view."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.viz.style import BEFORE, GREY, NEW

FRUSTUM_DEPTH = 0.45


class Points(NamedTuple):
    """Points of one colour in scene coordinates. A larger `weight` draws them larger."""

    name: str
    places: Float[np.ndarray, "n 3"]
    colour: str
    weight: float


class Cameras(NamedTuple):
    """Cameras of one colour, drawn as fields of view up to `depth` and numbered from `first`."""

    name: str
    poses: Sequence[Pose]
    camera: Camera
    colour: str
    first: int
    weight: float
    depth: float = FRUSTUM_DEPTH


def scene_items(
    before: Float[np.ndarray, "n 3"],
    new: Float[np.ndarray, "m 3"],
    poses: Sequence[Pose],
    camera: Camera,
    depth: float = FRUSTUM_DEPTH,
) -> tuple[Points | Cameras, ...]:
    """Return what to draw after a view: points and cameras. Those of this view have their own colour.

    - `before`, `new`: points of the cloud before this view, and points of this view.
    - `poses`: poses of all views so far, the last of this view.
    - `depth`: depth to which fields of view are drawn.
    """
    return (
        Points("points before", before, BEFORE, 0.7),
        Points("new points", new, NEW, 1.1),
        Cameras("cameras", poses[:-1], camera, GREY, 1, 0.9, depth),
        Cameras("new camera", poses[-1:], camera, NEW, len(poses), 1.5, depth),
    )


def frustum(pose: Pose, camera: Camera, depth: float = FRUSTUM_DEPTH) -> Float[np.ndarray, "lines 2 3"]:
    """Return the edges of a camera's field of view up to a depth, as segments in scene coordinates."""
    left, top, right, bottom = camera.edges
    corners = depth * np.array([[left, top, 1.0], [right, top, 1.0], [right, bottom, 1.0], [left, bottom, 1.0]])
    corners = corners @ np.asarray(pose.rotation, dtype=np.float64).T + np.asarray(pose.position)
    apex = np.broadcast_to(np.asarray(pose.position), corners.shape)
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return np.concatenate([np.stack([apex, corners], axis=1), sides])
