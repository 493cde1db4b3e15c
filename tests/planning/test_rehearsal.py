"""Compilation before the first image."""

import threading

import numpy as np
import pytest
from small_session import BOX, FIRST, POSES, planner_of, session_of, shot

import jaxnbv.geometry.depth_image as depth_image
import jaxnbv.planning.planner as planner_module
import jaxnbv.sampler as sampler_module
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import look_at
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.rehearsal import ball_on_a_table
from jaxnbv.search import DiscreteSearch


def test_the_image_is_of_a_ball_on_a_table():
    camera, box = Camera(fov=0.8, height=60, width=80), Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    pose = look_at((1.5, 2.0, 1.8))
    depth = ball_on_a_table(camera, pose, box)
    local = depth.reshape(-1, 1) * np.asarray(camera.pixel_directions())
    points = (local @ np.asarray(pose.rotation).T + np.asarray(pose.position))[depth.reshape(-1) > 0]
    on_ball = np.abs(np.linalg.norm(points, axis=1) - 0.4) < 1e-4
    on_table = np.abs(points[:, 1] + 1.0) < 1e-4
    assert (on_ball | on_table).all()
    assert min(on_ball.sum(), on_table.sum()) > 30
    # No ray passes through the ball: by the distance of each ray from its centre.
    rays = points - np.asarray(pose.position)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    past = np.linalg.norm(np.cross(-np.asarray(pose.position), unit), axis=1)
    assert on_ball[past < 0.39].all()


def sizes():
    """Number of compiled programs of each function that takes long to compile."""
    functions = planner_module._propose, sampler_module._sample, depth_image._points_and_normals
    return [function._jitted._cached._cache_size() for function in functions]


@pytest.fixture(scope="module")
def rehearsed():
    """A session with an image size that no other test has."""
    planner = planner_of(DiscreteSearch(14), num_samples=2, capacity=390)
    session = session_of(planner=planner, obstacles=None, poses=None)
    return session, session.rehearse()


def test_a_session_is_as_before_and_compiles_little_afterwards(rehearsed):
    session, rehearsal = rehearsed
    assert rehearsal.programs > 0
    assert str(rehearsal).startswith(f"{rehearsal.programs} programs in ")
    assert session.views == ()
    assert session.next_view is None
    before = sizes()
    assert min(before) > 0
    with pytest.warns(UserWarning, match="taken for a table"):
        session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    first = session.next()
    # Nothing large is compiled for the image and its proposal.
    assert sizes() == before
    again = session_of(planner=planner_of(DiscreteSearch(14), num_samples=2, capacity=390), obstacles=None, poses=None)
    with pytest.warns(UserWarning, match="taken for a table"):
        again.add(shot(FIRST), FIRST, depth_scale=1e-3)
    np.testing.assert_array_equal(again.next().matrix, first.matrix)
    # Everything is compiled.
    assert session.rehearse().programs == 0


def test_an_image_waits_until_a_rehearsal_ends():
    session = session_of(poses=POSES, box=BOX)
    adding = threading.Thread(target=session.add, args=(shot(FIRST), FIRST, 1e-3))
    # Hold the lock of `rehearse`.
    with session._rehearsal_lock:
        adding.start()
        adding.join(0.3)
        assert adding.is_alive()
        assert session.views == ()
    adding.join()
    assert len(session.views) == 1
