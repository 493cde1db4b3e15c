"""Rehearsal of a session, which compiles the session's programs before the first image."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.images import Image
from jaxnbv.planning.intake import Intake
from jaxnbv.planning.loop import Loop
from jaxnbv.programs import LOADED

_COMPILED = "/jax/core/compile/backend_compile_duration"
# Radius of the simulated ball, as a fraction of the box's shortest side.
_RADIUS = 0.2


class Rehearsal(NamedTuple):
    """Result of a rehearsal: how many programs it compiled or read from the cache, and its duration."""

    programs: int
    seconds: float

    def __str__(self) -> str:
        return f"{self.programs} programs in {self.seconds:.0f} s"


def rehearse(intake: Intake, loop: Loop) -> Rehearsal:
    """Add two simulated images of a ball on a table, and propose a pose after each image.

    Pass an intake and a loop without views, and do not use them afterwards, because the rehearsal changes them.
    """
    start, programs = time.monotonic(), 0

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        nonlocal programs
        programs += event in (_COMPILED, LOADED)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        frame, planner = intake.frame, loop.planner
        for pose in slanted_poses(planner.search.poses_around(), 2):
            depth = ball_on_a_table(frame.to_scene(intake.camera), pose, frame.to_scene(intake.box)) / frame.scale
            matrix = frame.to_world(pose).to_matrix(intake.convention)
            loop = intake.add(loop, Image.from_arrays(depth, matrix, 1.0, None)) or loop
            loop.done()
            loop.propose()
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return Rehearsal(programs, time.monotonic() - start)


def slanted_poses(poses: Pose, count: int) -> Pose:
    """Return the `count` poses that look down most nearly at 30 degrees, so that they see the table."""
    down = -np.asarray(poses.forward)[:, 1]
    return poses[jnp.asarray(np.argsort(np.abs(down - 0.5), kind="stable")[:count])]


def ball_on_a_table(camera: Camera, pose: Pose, box: Box) -> Float[np.ndarray, "height width"]:
    """Return a depth image of a ball in the middle of a box, with a table at the bottom (scene units).

    A pixel is zero if its ray misses the ball and the table, or if the hit is outside the camera's range.
    """
    origin = np.asarray(pose.position, np.float64)
    directions = np.asarray(camera.pixel_directions(), np.float64)
    rays = directions @ np.asarray(pose.rotation, np.float64).T
    middle, radius = 0.5 * (box.low + box.high), _RADIUS * float((box.high - box.low).min())
    projections, squared_lengths = rays @ (middle - origin), (rays**2).sum(axis=1)
    discriminants = projections**2 - squared_lengths * (((middle - origin) ** 2).sum() - radius**2)
    ball_depth = np.where(
        discriminants > 0, (projections - np.sqrt(np.maximum(discriminants, 0.0))) / squared_lengths, np.inf
    )
    with np.errstate(divide="ignore"):
        table_depth = (box.low[1] - origin[1]) / rays[:, 1]
    depth = np.minimum(np.where(ball_depth > 0, ball_depth, np.inf), np.where(table_depth > 0, table_depth, np.inf))
    farthest = np.inf if camera.farthest is None else camera.farthest
    is_measured = (depth >= camera.nearest) & (depth <= farthest) & np.isfinite(depth)
    return np.where(is_measured, depth, 0.0).reshape(camera.height, camera.width)
