"""Proposals that an arm can reach, and poses that it refuses."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_session import CENTER, POSES, begun, planner_of, shot

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.planning.session import Session
from jaxnbv.search import GradientSearch


@pytest.fixture(scope="module")
def values():
    """Values of the poses when all can be reached."""
    return np.asarray(begun().next().proposal.values)


@pytest.fixture(scope="module")
def free(values):
    """Indices of the poses by value, the highest first, when all can be reached."""
    return np.argsort(-values, kind="stable")


def number_of(matrix):
    """Index of a pose, whatever its roll."""
    away = np.abs(POSES[:, :3, 3] - matrix[:3, 3]).max(axis=1)
    assert away.min() < 1e-5
    return int(away.argmin())


def test_the_best_pose_that_can_be_reached_is_proposed_in_the_world(free):
    """Matrices in metres. All poses but the third best are too far from the arm's shoulder."""
    third = POSES[free[2], :3, 3]
    calls = []

    def reachable(matrices):
        calls.append(matrices)
        return [None if np.linalg.norm(place - third) < 1e-4 else "joint limit" for place in matrices[:, :3, 3]]

    session = begun(reachable=reachable)
    view = session.next()
    np.testing.assert_allclose(view.matrix, POSES[free[2]], atol=1e-5)
    assert view.refusals == {"joint limit": 2}
    assert view.value == pytest.approx(float(session.frame.length_to_world(view.proposal.values[free[2]], 2)), rel=1e-5)
    # Calls are batches. Other rolls are tried only for the two refused poses.
    assert [len(matrices) for matrices in calls] == [8, 7, 7]
    assert session.next() is view


def test_a_camera_may_be_turned_about_its_optical_axis(free):
    """The arm can hold the camera only with the image rotated by a right angle."""
    best = POSES[free[0]]

    def reachable(matrices):
        return np.abs(matrices[:, 2, 0]) > 0.5

    view = begun(reachable=reachable).next()
    np.testing.assert_allclose(view.matrix[:3, 2:], best[:3, 2:], atol=1e-5)
    cosine = view.matrix[:3, 0] @ best[:3, 0]
    assert abs(cosine) < 0.75
    assert abs(view.matrix[2, 0]) > 0.5
    assert view.refusals == {}


def test_a_proposal_that_is_refused_is_not_made_again(free, tmp_path):
    session = begun(folder=tmp_path)
    assert number_of(session.next().matrix) == free[0]
    samples = session._loop.inputs()
    session.refuse("cable")
    assert number_of(session.next().matrix) == free[1]
    assert session.next().refusals == {"cable": 1}
    assert session._loop.inputs() is samples
    # No camera was there, and a session that is loaded continues.
    assert len(session.views) == int(session.observations.num_views) == 1
    again = Session.load(tmp_path)
    assert number_of(again.next().matrix) == free[1]
    again.refuse()
    assert number_of(again.next().matrix) == free[2]
    again.add(shot(POSES[free[2]]), POSES[free[2]], depth_scale=1e-3)
    assert number_of(again.next().matrix) not in free[:3]


def test_a_gradient_search_ends_at_a_pose_that_holds():
    """Only poses above a height are allowed, and the best pose of the search is below."""
    planner, places = planner_of(GradientSearch(num_starts=2, iterations=3, num_candidates=12)), []
    free = begun(planner=planner, poses=None).next().matrix
    limit = float(free[2, 3]) + 0.02

    def reachable(matrices):
        places.extend(matrices[:, 2, 3])
        return matrices[:, 2, 3] > limit

    view = begun(planner=planner, poses=None, reachable=reachable).next()
    assert view.matrix[2, 3] > limit
    # The camera still looks at the middle of the box.
    ahead = CENTER - view.matrix[:3, 3]
    assert view.matrix[:3, 2] @ ahead / np.linalg.norm(ahead) > 0.999
    assert view.refusals["not reachable"] >= 1


def test_unreachable_candidates_are_reported():
    session = begun(reachable=lambda matrices: ["collision" if x > CENTER[0] else "too far" for x in matrices[:, 0, 3]])
    with pytest.raises(InputError, match=r"none of the \d+ poses .* can be reached \(\d+ [a-z ]+, \d+ [a-z ]+\): give"):
        session.next()
    with pytest.raises(InputError, match="no proposal to refuse: ask session"):
        session.refuse()
    session.reachable = lambda matrices: 0.5
    with pytest.raises(InputError, match=r"reachable returned 0\.5 for 8 poses: return a list with an answer for each"):
        session.next()
    session.reachable = lambda matrices: [1.5] * len(matrices)
    with pytest.raises(InputError, match=r"reachable returned 1\.5 for a pose: return a bool; None if .* from 0 to 1"):
        session.next()
    session.reachable = lambda matrices: ["collision"] * len(matrices)
    with pytest.raises(InputError, match=r"none of the 1 of the \d+ poses .*\(1 collision\).*, or more seconds"):
        session.next(seconds=0.0)


def test_a_score_is_multiplied_by_the_value(free, values):
    """The choice has the highest product of value and score, although not all poses are checked."""
    scores = np.random.default_rng(0).uniform(0.3, 1.0, len(POSES))
    scores[free[3]] = 0.0
    calls = []

    def reachable(matrices):
        calls.extend(number_of(matrix) for matrix in matrices)
        return [scores[number_of(matrix)] for matrix in matrices]

    view = begun(reachable=reachable).next()
    best = int(np.argmax(scores * values))
    assert best != free[0]
    assert number_of(view.matrix) == best
    assert float(view.proposal.value) == pytest.approx(values[best], rel=1e-6)
    # At most one batch more than needed, and seven rolls of the pose with score zero.
    can_win = int((values > scores[best] * values[best]).sum())
    assert len(set(calls)) <= 8 * (can_win // 8 + 1)


@pytest.mark.parametrize(("height", "width", "low", "high"), [(8, 24, 0.9, 1.1), (16, 16, 0.6, 0.8)])
def test_the_value_of_a_rolled_camera_is_imagined_again(free, height, width, low, high):
    """A wide image rolled by a right angle and a square image rolled by 45 degrees both show something else."""

    def reachable(matrices):
        across = np.abs(matrices[:, 2, 0])
        return (low < across) & (across < high)

    camera = Camera(height=height, width=width)
    session = begun(planner=dataclasses.replace(planner_of(), camera=camera), reachable=reachable)
    view = session.next()
    pose = view.proposal.pose
    assert float(session.planner.values_at(session._loop.inputs(), pose[None])[0]) == pytest.approx(
        float(view.proposal.value), rel=1e-5
    )
    upright = view.proposal.values
    assert float(jnp.abs(upright - view.proposal.value).min()) > 1e-4 * float(upright.max())
