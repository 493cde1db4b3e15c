"""A stored session, planned again."""

import numpy as np
import pytest
from commands import run_command
from small_session import BOX, CAMERA, FIRST, planner_of, session_of, shot

from jaxnbv.checks import InputError
from jaxnbv.planning.replay import StoredSession
from jaxnbv.search import FarthestView, GradientSearch


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The folder of a session of three images, the last two where it asked for them, and the session."""
    folder = tmp_path_factory.mktemp("session") / "live"
    session = session_of(folder)
    session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    for _ in range(2):
        matrix = session.next().matrix
        session.add(shot(matrix), matrix, depth_scale=1e-3)
    session.next()
    return folder, session


def test_what_is_stored_is_read_without_the_planner(stored):
    folder, session = stored
    found = StoredSession(folder)
    assert found.cameras == (CAMERA,)
    assert (found.box.low, found.box.high) == BOX
    assert found.up == "z"
    assert found.views == 3
    np.testing.assert_array_equal(found.image(0).depth, shot(FIRST))
    pose, cloud = found.first_view()
    view = session.episode.views[0]
    np.testing.assert_array_equal(pose.position, view.pose.position)
    np.testing.assert_array_equal(cloud.points, view.scan.points)


def test_the_same_planner_asks_for_the_same(stored, tmp_path):
    folder, session = stored
    asked = [proposed for _, proposed in StoredSession(folder).replay(planner_of(), tmp_path / "again")]
    assert len(asked) == 3
    for index, proposed in enumerate(asked):
        expected = session.next() if index == 2 else None
        proposal = expected.proposal if expected else session.episode.views[index + 1].proposal
        np.testing.assert_allclose(proposed.proposal.values, proposal.values, rtol=1e-4)
        np.testing.assert_allclose(proposed.proposal.pose.position, proposal.pose.position, atol=1e-5)
    assert len(list((tmp_path / "again").glob("image_*.npz"))) == 3
    (tmp_path / "again" / "proposal_03.npz").unlink()
    assert len([*StoredSession(folder).replay(planner_of(), tmp_path / "again")]) == 1
    assert (tmp_path / "again" / "proposal_03.npz").exists()


def test_another_planner_looks_elsewhere_among_the_same_poses(stored):
    folder, session = stored
    asked = [proposed for _, proposed in StoredSession(folder).replay(planner_of(FarthestView()))]
    places = np.asarray(session.next().proposal.candidates.position)
    taken = np.array([view.pose.position for view in session.episode.views])
    for count, proposed in enumerate(asked, start=1):
        distance = np.linalg.norm(places[:, None] - taken[None, :count], axis=-1).min(axis=1)
        values = np.asarray(proposed.proposal.values)
        np.testing.assert_allclose(values[np.isfinite(values)], distance[np.isfinite(values)], rtol=1e-4)


@pytest.mark.slow
def test_a_search_by_gradient_takes_its_own_poses(stored):
    search = GradientSearch(dof=2, num_starts=1, iterations=1, num_candidates=2)
    _, proposed = next(StoredSession(stored[0]).replay(planner_of(search)))
    assert proposed.proposal.trajectories is not None


def test_what_cannot_be_replayed_is_named(stored, tmp_path):
    folder, _ = stored
    with pytest.raises(InputError, match=r"session\.json is not a session's record"):
        StoredSession(tmp_path)
    with pytest.raises(InputError, match="holds the session that is to be replayed: choose another folder"):
        next(StoredSession(folder).replay(planner_of(), folder))
    session_of(tmp_path / "empty")
    with pytest.raises(InputError, match=r"session\.json is not a session's record"):
        StoredSession(tmp_path / "empty")


def test_the_command_says_where_another_task_would_have_looked(stored, tmp_path):
    folder, _ = stored
    out = tmp_path / "out"
    result = run_command(
        "session", "replay", str(folder), "--task", "heat", "--source", "0.3,0.2,0.2", "--search", "farthest",
        "--quick", "--no-report", "--out", str(out), cwd=tmp_path,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert [line.split()[1] for line in lines if line.startswith("image")] == ["1", "2", "3"]
    assert sum("taken from" in line for line in lines) == 2
    assert sum("coldest at" in line for line in lines) == 3
    assert (out / "session.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--task", "parts"), "--task parts needs --category"),
        (("--task", "coverage", "--source", "0,0,0"), "--task coverage takes no --source"),
        (("--task", "heat", "--source", "9,0,0"), "away from the object"),
    ],
)
def test_a_command_without_what_it_needs_is_refused(stored, tmp_path, options, message):
    result = run_command("session", "replay", str(stored[0]), *options, "--quick", cwd=tmp_path)
    assert result.returncode == 2
    assert message in result.stderr
