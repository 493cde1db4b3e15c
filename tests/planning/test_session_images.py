"""Images that a session refuses, or leaves out."""

import numpy as np
import pytest
from small_session import FIRST, POSES, begun, session_of, shot

from jaxnbv.checks import InputError


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"depth_scale": 1.0}, "give the depth's scale, 0.001 for millimetres"),
        ({"matrix": FIRST @ np.diag([-1.0, 1.0, -1.0, 1.0])}, "the box .* lies behind the camera"),
        ({"depth": np.ones((5, 5))}, r"the depth image is \(5, 5\) but the camera has \(48, 64\)"),
        ({"depth": np.zeros((48, 64))}, "the first scan is empty: no point to start from"),
    ],
)
def test_a_wrong_image_is_named_and_changes_nothing(given, message, tmp_path):
    session = session_of(tmp_path)
    right = {"depth": shot(FIRST), "matrix": FIRST, "depth_scale": 1e-3}
    with pytest.raises(InputError, match=message):
        session.add(**right | given)
    assert len(session.views) == 0
    assert not list(tmp_path.glob("*.npz"))
    session.add(**right)
    assert len(session.views) == 1


def test_an_image_beside_the_box_is_warned_of():
    """It may be intended, except for the first image."""
    session = session_of()
    inverse = np.linalg.inv(FIRST)
    problem = r"none of the \d+ points .* lies in the box .* Is the pose from camera to world"
    with pytest.raises(InputError, match=f"the first image shows nothing of the box: {problem}"):
        session.add(shot(FIRST), inverse, depth_scale=1e-3)
    session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    with pytest.warns(UserWarning, match=problem):
        session.add(shot(POSES[0]), inverse, depth_scale=1e-3)


def test_an_image_of_an_earlier_moment_than_its_pose_is_refused(tmp_path):
    """Also by a session that is loaded from its folder. From the same pose the image may be added again. In metres, NaN
    stands for no measurement."""
    begun(tmp_path)
    session, stale = session_of(tmp_path), shot(FIRST)
    with pytest.raises(InputError, match=r"bit for bit equal to image 1, which has a diff.*Discard the frames"):
        session.add(stale.copy(), POSES[0], depth_scale=1e-3)
    session.add(stale, FIRST.astype(np.float32), depth_scale=1e-3)
    stale[20, 20] += 1
    session.add(stale, POSES[0], depth_scale=1e-3)
    metres = np.where(stale > 400, 1e-3 * stale, np.nan)
    session.add(metres, POSES[1])
    with pytest.raises(InputError, match="bit for bit equal to image 4"):
        session.add(metres.copy(), POSES[2])
    assert len(session.views) == len(list(tmp_path.glob("image_*"))) == 4


def test_a_later_image_that_measured_nothing_is_no_view(tmp_path):
    session = begun(tmp_path)
    before = session.observations
    for index, value in enumerate((0, 65535, 10000, np.nan)):
        image = np.full((48, 64), value, float if index == 3 else np.uint16)
        with pytest.warns(UserWarning, match="measured nothing .* left out: take it again"):
            session.add(image, POSES[index], depth_scale=1e-3)
    assert len(session.views) == len(list(tmp_path.glob("image_*"))) == 1
    assert session.observations is before
    # An image past the object is a view.
    session.add(np.full((48, 64), np.inf), POSES[0], depth_scale=1e-3)
    assert len(session.views) == 2
