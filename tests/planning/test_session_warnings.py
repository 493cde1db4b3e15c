"""Warnings of a session: of its box, its table and its poses."""

import warnings

import numpy as np
import pytest
from small_session import BOX, CAMERA, FIRST, POSES, around, begun, planner_of, session_of, shot

from jaxnbv.geometry.pose import look_at
from jaxnbv.geometry.volume import Box
from jaxnbv.scanning import Obstacles
from jaxnbv.search import HalvingSearch

AWAY = POSES @ np.diag([-1.0, 1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("planner", "worth"),
    [(planner_of(), "0 ± 0"), (planner_of(num_samples=1), "0"), (planner_of(HalvingSearch()), "0 ± 0")],
    ids=["several samples", "one sample", "default search"],
)
def test_poses_that_look_away_have_no_value_and_warn(planner, worth):
    """A single sample has no standard error."""
    session = begun(poses=AWAY, planner=planner)
    with pytest.warns(UserWarning, match=rf"the best view is worth {worth}: none is sure.*give poses that look at the"):
        session.next()
    assert (session.next().standard_error is None) == (worth == "0")


def test_a_box_that_cuts_the_object_warns_once_for_each_face():
    """Two centimetres of the ball are beyond the box at +x, and nothing at the other faces."""
    session = session_of(box=(BOX[0], (0.38, 0.32, 0.24)))
    with pytest.warns(UserWarning, match=r"beyond the box at \+x: \d+ % of the points .* larger box") as warning_list:
        session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    assert len(warning_list) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        session.add(shot(POSES[0]), POSES[0], depth_scale=1e-3)


DEEP = (0.18, 0.08, -0.02), BOX[1]
BELOW = np.array([[around(angle, -0.4), around(angle, 0.6)] for angle in (0.5, 2.5, 4.5)]).reshape(-1, 4, 4)


def test_the_table_is_detected_and_avoided_with_a_warning():
    """The box reaches two centimetres into the table. Half of the poses are below the table. The table is part of the
    object on request."""
    session = session_of(box=DEEP, poses=BELOW, obstacles=None)
    with pytest.warns(UserWarning, match=r"stands on a plane through \[.*, -0\.00.*Obstacles\(\) to keep it"):
        session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    points, _ = session.cloud.to_numpy()
    # The rest of the table is nearer to the ball than the margin.
    assert (points[:, 2] > 0.001).mean() > 0.98
    assert np.isneginf(np.asarray(session.next().proposal.values)[::2]).all()
    assert session.next().matrix[2, 3] > 0.1
    kept = session_of(box=DEEP, poses=BELOW)
    with pytest.warns(UserWarning, match="go on beyond the box") as warning_list:
        kept.add(shot(FIRST), FIRST, depth_scale=1e-3)
    assert not any("stands on a plane" in str(one.message) for one in warning_list)
    points, _ = kept.cloud.to_numpy()
    assert (points[:, 2] < 0.001).mean() > 0.1
    assert np.isfinite(np.asarray(kept.next().proposal.values)).all()


def test_a_room_scanned_from_inside_needs_poses_inside():
    """The warning comes once, at the first image from inside."""
    half, place = np.array([2.0, 1.5, 1.2]), np.array([0.3, -0.2, 0.1])
    images = []
    for target in ((2.0, 0.5, 0.0), (-2.0, 0.5, 0.0)):
        pose = look_at(place, target, up=(0.0, 0.0, 1.0))
        directions = np.asarray(CAMERA.pixel_directions(), np.float64) @ np.asarray(pose.rotation, np.float64).T
        depth = np.min((np.sign(directions) * half - place) / directions, axis=1).reshape(48, 64)
        images.append((depth, np.asarray(pose.matrix, np.float64)))
    room = (tuple(-half - 0.05), tuple(half + 0.05))
    session = session_of(box=room, poses=None)
    with pytest.warns(UserWarning, match=r"stands inside the box, but all \d+ candidates stand outside .*poses="):
        session.add(*images[0])
    inside = session_of(box=room, poses=np.stack([matrix for _, matrix in images]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        session.add(*images[1])
        inside.add(*images[0])
    assert np.asarray(Box(*room)(inside.next().matrix[:3, 3])) < 0


@pytest.mark.parametrize("up", ["y", "-x", "-z"])
def test_the_table_reveals_a_wrong_up(up):
    """The warning comes once, with the right axis."""
    session = session_of(box=DEEP, obstacles=None, up=up)
    with pytest.warns(UserWarning, match="no table is found") as warning_list:
        session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    message = f'no table is found with up="{up}", but a plane would be one with up="z": give that'
    assert [message in str(one.message) for one in warning_list].count(True) == 1


def test_a_missing_table_warns_unless_obstacles_are_given():
    away = shot(FIRST) * np.linalg.norm(CAMERA.pixel_directions(), axis=1).reshape(48, 64)
    image = np.where(away < 600.0, shot(FIRST), 0)
    session = session_of(obstacles=None)
    with pytest.warns(UserWarning, match=r'no table .* under the box with up="z".*Obstacles\(\) if there is none'):
        session.add(image, FIRST, depth_scale=1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        session.add(image, FIRST, depth_scale=1e-3)
        session_of(obstacles=Obstacles()).add(image, FIRST, depth_scale=1e-3)
