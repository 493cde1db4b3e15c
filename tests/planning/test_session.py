"""A live session with a simulated sensor."""

import dataclasses

import jax
import numpy as np
import pytest
import trimesh
from small_session import BOX, CAMERA, FIRST, POSES, WORLD, around, begun, planner_of, session_of, shot

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.loop import view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.session import Session
from jaxnbv.planning.stopping import Budget, StopRule, ValueBelow
from jaxnbv.planning.travel import ValuePerCost
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.scanning import Carving, Grid, scan
from jaxnbv.search import DiscreteSearch, FarthestView, GradientSearch, SphereCandidates
from jaxnbv.surfaces import GeometricSPSR, OutsideBoundary, ScreenedSPSR
from jaxnbv.tasks import Coverage
from jaxnbv.viz import write_report

CENTER_OF_BOX, KEY = np.mean(BOX, axis=0), jax.random.key(4)


@pytest.fixture(scope="module")
def finished():
    """A session of three views."""
    session = begun(key=KEY)
    for _ in range(2):
        matrix = session.next().matrix
        session.add(shot(matrix), matrix, depth_scale=1e-3)
    return session


def test_a_session_equals_a_planner_in_the_scene(finished):
    """Every step by hand, with the frame."""
    frame = Frame.fit(np.array(BOX), up="z")
    box = Box(*BOX)
    search = DiscreteSearch(frame.to_scene(Pose.from_matrix(POSES)))
    imagined = frame.to_scene(CAMERA).resized(12, 16)
    sampler = SurfaceSampler(GeometricSPSR(0.2, truncation=8), Grid(28), 3, Carving(frame.to_scene(box)))
    planner = Planner(Coverage(), search, imagined, sampler, capacity=400, max_views=8)
    observations, matrix = None, FIRST
    for index in range(3):
        pose = Pose.from_matrix(matrix)
        cloud = PointCloud.from_depth(shot(matrix), CAMERA, pose, depth_scale=1e-3, box=box)
        in_scene = (frame.to_scene(pose), frame.to_scene(cloud), frame.to_scene(CAMERA))
        observations = planner.init(*in_scene) if observations is None else planner.observe(observations, *in_scene)
        sample_key, search_key, _ = view_keys(KEY, index + 1)
        surfaces = planner.sampler.sample(observations, sample_key)
        proposal = planner.choose(StepInputs(observations, None, surfaces), search_key)
        matrix = np.asarray(frame.to_world(proposal.pose).matrix)
        expected = finished.episode.views[index + 1].proposal if index < 2 else finished.next().proposal
        np.testing.assert_allclose(proposal.values, expected.values, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(proposal.pose.position, expected.pose.position, atol=1e-5)
    np.testing.assert_allclose(finished.observations.cloud.points, observations.cloud.points, atol=1e-5)


def test_its_matrices_are_the_users(finished):
    proposed = finished.next()
    distance = np.abs(POSES - proposed.matrix).max(axis=(1, 2))
    assert distance.min() < 1e-5
    index = int(np.argmax(np.asarray(proposed.proposal.values)))
    assert int(distance.argmin()) == index
    # The value is an area. The box is 0.24 m wide, and 2.5 in the scene.
    unit = (2.5 / max(np.subtract(BOX[1], BOX[0]))) ** 2
    assert proposed.value * unit == pytest.approx(float(proposed.proposal.values[index]))
    assert proposed.standard_error * unit == pytest.approx(float(proposed.proposal.standard_errors[index]))
    assert finished.next() is proposed
    assert len(finished.views) == 3


def test_its_cloud_lies_on_the_object_in_the_world(finished, tmp_path):
    """Without the rim about the box, which is modelled. The rim is not below the box, where the table is."""
    points, normals = finished.cloud.to_numpy()
    outward = points - np.array([0.3, 0.2, 0.101])
    assert len(points) == 400
    assert np.abs(np.linalg.norm(outward, axis=1) - 0.1).max() < 0.004
    assert np.median(np.sum(outward * normals, axis=1)) / 0.1 > 0.95
    assert np.asarray(Box(*BOX)(points)).max() <= 0
    modelled, _ = finished.frame.to_world(finished.observations.cloud).to_numpy()
    assert modelled[:, 2].min() >= BOX[0][2] - 1e-6
    finished.episode.save(tmp_path)
    np.testing.assert_allclose(trimesh.load(tmp_path / "cloud.ply").vertices, points, atol=1e-6)


def test_the_expected_depth_is_near_what_is_then_seen(finished):
    """In metres at the planner's resolution, by the sensor's pixels on its rays where both see the ball."""
    proposed, expected = finished.next(), finished.expected_depth()
    assert expected.shape == (12, 16)
    camera = CAMERA.resized(12, 16)
    cloud = scan(WORLD, camera, Pose.from_matrix(proposed.matrix))
    inside = np.asarray(Box(*BOX)(cloud.points)) < 0
    depth = (np.asarray(cloud.points) - proposed.matrix[:3, 3]) @ proposed.matrix[:3, 2]
    both = (np.asarray(cloud.mask) & inside).reshape(12, 16) & np.isfinite(expected)
    assert both.sum() > 15
    assert np.median(np.abs(expected - depth.reshape(12, 16))[both]) < 0.02


def test_metres_and_millimetres_and_both_conventions_tell_the_same(finished):
    axes = np.diag([1.0, -1.0, -1.0, 1.0])
    session = session_of(convention="opengl", poses=POSES @ axes, key=KEY)
    session.add(shot(FIRST, 1.0), FIRST @ axes)
    # Points that are rounded to millimetres differ, and so do the values.
    first = finished.episode.views[1].proposal.pose
    np.testing.assert_allclose(session.next().matrix @ axes, finished.frame.to_world(first).matrix, atol=1e-5)


@pytest.mark.parametrize("elevation", [-0.5 * np.pi, -0.3, 0.5])
def test_default_poses_are_above_the_object(elevation):
    search = DiscreteSearch(SphereCandidates(60, min_elevation=elevation))
    session = session_of(poses=None, planner=planner_of(search))
    places = np.asarray(session.frame.to_world(session.planner.search.candidates.poses()).position)
    away = places - np.mean(BOX, axis=0)
    lowest = np.arcsin((away[:, 2] / np.linalg.norm(away, axis=1)).min())
    least = 0.0 if elevation == -0.5 * np.pi else elevation
    assert least - 1e-3 < lowest < least + 0.1


def test_nothing_recompiles_after_the_second_image(compilations):
    session, after = session_of(), []
    matrix = FIRST
    for _ in range(5):
        session.add(shot(matrix), matrix, depth_scale=1e-3)
        matrix = session.next().matrix
        after.append(len(compilations))
    assert after[2:] == [after[2]] * 3
    jax.lax.neg(np.ones(1741, np.float32))
    assert len(compilations) > after[-1], "the counter does not see eager operations"


def test_an_unreached_pose_is_not_proposed_again():
    """The user takes the image from elsewhere. Then all other poses are proposed once, and no pose is left."""
    session = session_of(planner=planner_of(FarthestView()), poses=POSES[:4])
    proposed = []
    for angle in (0.2, 1.2, 2.2, 3.2):
        matrix = around(angle, 0.6)
        session.add(shot(matrix), matrix, depth_scale=1e-3)
        proposed.append(session.next().matrix)
    assert len({tuple(np.round(matrix[:3, 3], 4)) for matrix in proposed}) == 4
    session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    with pytest.raises(InputError, match="all 4 candidates have been visited"):
        session.next()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: session_of().next(), "no image yet: add one first"),
        (lambda: session_of().observations, "no image yet: add one first"),
        (lambda: session_of().episode, "no image yet: add one first"),
        (lambda: session_of(box=((0.0, 0.0), (1.0, 1.0))), "give two corners"),
        (lambda: session_of(box=((0.0, 0.0, 0.0), (1.0, 1.0, -1.0))), "has no inside"),
        (lambda: session_of(planner=planner_of(GradientSearch())), "GradientSearch is no search over candidates"),
        (lambda: session_of(convention="blender"), "the convention is 'blender'"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_the_box_is_the_volume_of_the_model_and_of_the_carving():
    """A model with an explicit volume keeps it."""
    own = Box.cube(2.0)
    sampler = SurfaceSampler(ScreenedSPSR(values=(OutsideBoundary(), OutsideBoundary(own))))
    fitted = session_of(planner=Planner(Coverage(), camera=Camera(height=12, width=16), sampler=sampler)).planner
    scene = Frame.fit(np.array(BOX), up="z").to_scene(Box(*BOX))
    assert fitted.sampler.carving.volume == scene
    assert fitted.sampler.model.values[0].volume == scene
    assert fitted.sampler.model.values[1].volume == own
    assert max(scene.high) == pytest.approx(1.25)
    assert fitted.camera.fov == pytest.approx(CAMERA.fov)


def test_travel_counts_from_where_the_camera_was(finished):
    """Not from the proposed pose. In metres about the middle of the box."""
    plain, priced = begun(), begun(planner=dataclasses.replace(planner_of(), cost=ValuePerCost(fixed=0.5)))
    actual = around(3.0, 0.7)
    for session in (plain, priced):
        proposed = session.next().matrix
        assert np.abs(proposed - actual).max() > 0.1
        session.add(shot(actual), actual, depth_scale=1e-3)
    start, end = actual[:3, 3] - CENTER_OF_BOX, POSES[:, :3, 3] - CENTER_OF_BOX
    radii = np.linalg.norm(start), np.linalg.norm(end, axis=1)
    angle = np.arccos(end @ start / radii[0] / radii[1])
    cost = np.hypot(0.5 * (radii[0] + radii[1]) * angle, radii[1] - radii[0])
    values, weighed = (np.asarray(session.next().proposal.values) for session in (plain, priced))
    open_ = np.isfinite(weighed)
    np.testing.assert_allclose(weighed[open_] * (0.5 + cost[open_]), values[open_], rtol=1e-3)
    assert priced.next().value == pytest.approx(float(weighed.max()) / priced.frame.scale**2)


def test_distances_are_metres_to_cameras_that_were_there():
    """A proposal that was not followed is not proposed again, but no camera stood there."""
    session = begun(planner=planner_of(FarthestView()))
    refused, actual = session.next().matrix, around(3.3, 0.4)
    session.add(shot(actual), actual, depth_scale=1e-3)
    places = np.array([FIRST[:3, 3], actual[:3, 3]])
    distance = np.linalg.norm(POSES[:, None, :3, 3] - places, axis=-1).min(axis=1)
    is_refused = np.abs(POSES - refused).max(axis=(1, 2)) < 1e-5
    assert is_refused.sum() == 1
    assert session.next().value == pytest.approx(distance[~is_refused].max(), rel=1e-4)


class Samples(StopRule):
    """A rule that uses the posterior samples, and never ends a session."""

    def after(self, context):
        assert context.surfaces().values.ndim == 4


def test_done_and_next_share_their_samples(monkeypatch, tmp_path):
    drawn, sample = [], SurfaceSampler.sample
    monkeypatch.setattr(SurfaceSampler, "sample", lambda *args: drawn.append(1) or sample(*args))
    session = begun(tmp_path, until=ValueBelow(0.0) | Samples())
    assert session.done() is None
    assert not list(tmp_path.glob("proposal*")), "what is only asked about is not stored"
    session.next()
    assert session.done() is None
    assert len(drawn) == 1


def test_views_that_only_a_rule_scored_are_not_proposed(tmp_path):
    """After a call of `done` alone, an image of the user's follows no proposal, live and after loading."""
    session = begun(tmp_path, until=ValueBelow(0.0))
    assert session.done() is None
    actual = around(3.0, 0.7)
    session.add(shot(actual), actual, depth_scale=1e-3)
    again = Session.load(tmp_path, progress=False)
    assert session.views[1].proposal is again.views[1].proposal is None
    np.testing.assert_array_equal(session.next().proposal.values, again.next().proposal.values)
    # The proposal is there when the folder is loaded.
    resumed = Session.load(tmp_path, progress=False)
    np.testing.assert_array_equal(resumed.next_view.matrix, session.next().matrix)
    assert resumed.next_view.value == session.next().value


def test_it_is_done_by_its_rule_of_the_value_that_the_user_sees(finished):
    assert finished.done() is None
    assert session_of(until=ValueBelow(1e9)).done() is None
    assert begun(until=Budget(seconds=1e9)).done() is None
    value = begun().next().value
    session = begun(until=ValueBelow(1.001 * value))
    assert "less than" in session.done()
    assert session.episode.stop_reason == session.done()
    assert begun(until=ValueBelow(0.999 * value)).done() is None


@pytest.mark.slow
def test_a_report_stands_upright_and_needs_no_truth(finished, tmp_path):
    page = write_report(finished.episode, tmp_path, progress=False).read_text()
    assert "that of a real sensor" in page
    assert page.count("<li>View") == 3
