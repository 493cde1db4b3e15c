"""Alignment of views with wrong poses, against the simulated errors: points and planes in float64."""

import re
import warnings

import numpy as np
import pytest
import small_gicp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_session import around, session_of, shot

from jaxnbv.checks import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.planning.alignment import _exponential, _in_camera, _linearise, _match_points, align_views, errors_of

SIDES = np.array([0.12, 0.2, 0.15])
AXES = np.concatenate([np.eye(3), -np.eye(3)])
ANGLES, TILTS = np.array([[0.2, 0.9, 1.6, 2.3, -0.5, 0.5], [0.6, 0.9, 0.3, 0.8, 0.4, 0.1]])
EYES = 0.6 * np.stack([np.cos(ANGLES) * np.cos(TILTS), np.sin(ANGLES) * np.cos(TILTS), np.sin(TILTS)], axis=1)


def random_motion(seed, degrees, length):
    random = np.random.default_rng(seed)
    turn, shift = random.normal(size=(2, 3))
    turn *= np.radians(degrees) / np.linalg.norm(turn)
    return _exponential(np.append(turn, shift * length / np.linalg.norm(shift)))


def views_of_a_box(errors, noise=0.0, eyes=EYES, roll=True):
    """Scans by cameras of a box of 24 x 40 x 30 cm, and the reported poses, which have the errors."""
    clouds, poses = [], []
    for number, (eye, error) in enumerate(zip(eyes, errors, strict=True)):
        random = np.random.default_rng(number)
        face = random.integers(6, size=4000)
        points = random.uniform(-1.0, 1.0, (4000, 3))
        points[np.arange(4000), face % 3] = np.where(face < 3, 1.0, -1.0)
        points, normals = SIDES * points, AXES[face]
        is_visible = np.sum(normals * (np.array(eye) - points), axis=1) > 0
        points, normals = points[is_visible], normals[is_visible]
        points += noise * random.normal(size=(len(points), 1)) * normals
        up = Rotation.from_rotvec([0.0, 0.0, number * roll]).apply([1.0, 0.0, 0.2])
        true = np.asarray(look_at(eye, up=up).to_matrix(), np.float64)
        said = true @ np.linalg.inv(error)
        moved = said @ np.linalg.inv(true)
        points, normals = points @ moved[:3, :3].T + moved[:3, 3], normals @ moved[:3, :3].T
        clouds.append(PointCloud.from_arrays(points, normals, 3000))
        poses.append(Pose.from_matrix(said))
    return clouds, poses


def apart(one, other):
    """Difference of two motions: degrees and length."""
    change = np.linalg.inv(one) @ other
    return np.degrees(Rotation.from_matrix(change[:3, :3]).magnitude()), np.linalg.norm(change[:3, 3])


@settings(max_examples=4)
@given(st.integers(0, 1000), st.floats(1.0, 3.0), st.floats(0.001, 0.015))
def test_the_error_of_the_mount_is_found(seed, degrees, length):
    error = random_motion(seed, degrees, length)
    clouds, poses = views_of_a_box(len(EYES) * [error], noise=0.0005)
    alignment = align_views(clouds, poses)
    assert alignment.is_mount
    assert alignment.is_determined
    assert alignment.disagrees
    angle, shift = apart(error, alignment.corrections[0])
    # The least determined component is underestimated by a few percent.
    assert angle < 0.1
    assert shift < 0.0015
    np.testing.assert_array_equal(alignment.corrections, alignment.corrections[:1].repeat(len(EYES), axis=0))
    assert np.nanmax(alignment.corrected) < 2.0 * alignment.noise
    deviations = np.sqrt(np.diag(alignment.covariance))
    assert deviations[:3].max() < np.radians(0.3)
    assert deviations[3:].max() < 0.003


def test_exact_poses_stay_as_they_are():
    alignment = align_views(*views_of_a_box(len(EYES) * [np.eye(4)], noise=0.0005))
    np.testing.assert_array_equal(alignment.corrections, np.tile(np.eye(4), (len(EYES), 1, 1)))
    assert not alignment.disagrees
    np.testing.assert_array_equal(alignment.corrected, alignment.disagreement)


def test_the_error_of_a_single_pose_is_its_own():
    """Its view moves as small_gicp moves the points onto all others by generalised ICP, without a model of the
    mount."""
    errors = len(EYES) * [np.eye(4)]
    # It sees three faces that other views see too, which determines its error.
    errors[1] = random_motion(5, 1.5, 0.008)
    clouds, poses = views_of_a_box(errors, noise=0.0005)
    alignment = align_views(clouds, poses)
    assert not alignment.is_mount
    assert np.argmax(alignment.disagreement) == 1
    angle, shift = apart(errors[1], alignment.corrections[1])
    assert angle < 0.2
    assert shift < 0.003
    angles, shifts = errors_of(alignment.corrections)
    assert np.argmax(angles) == np.argmax(shifts) == 1
    source = clouds[1].to_numpy()[0].astype(np.float64)
    others = [cloud.to_numpy()[0] for index, cloud in enumerate(clouds) if index != 1]
    result = small_gicp.align(
        np.concatenate(others).astype(np.float64),
        source,
        registration_type="GICP",
        downsampling_resolution=0.004,
        max_correspondence_distance=0.02,
    )
    assert result.converged
    said = np.asarray(poses[1].to_matrix(), np.float64)
    ours = said @ alignment.corrections[1] @ np.linalg.inv(said)
    corrected, oracle = (source @ motion[:3, :3].T + motion[:3, 3] for motion in (ours, result.T_target_source))
    moved = np.linalg.norm(corrected - source, axis=1)
    # The errors move points by 1 cm. Both methods move them to the same place, to a tenth of that.
    assert moved.mean() > 0.008
    assert np.linalg.norm(corrected - oracle, axis=1).mean() < 0.1 * moved.mean()


def test_views_without_rotation_do_not_determine_a_shift_of_the_mount():
    """All cameras have the same orientation, so that a shift of the mount shifts all scans alike."""
    ahead = np.asarray(look_at(EYES[0]).to_matrix(), np.float64)[:3, :3]
    (cloud, *_), _ = views_of_a_box([np.eye(4)], eyes=EYES[:1])
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = ahead, np.array(EYES[0]) + 0.03 * np.arange(4)[:, None]
    alignment = align_views(4 * [cloud], [Pose.from_matrix(matrix) for matrix in matrices])
    assert not alignment.is_determined
    assert not alignment.is_corrected
    assert np.sqrt(np.diag(alignment.covariance)[3:].max()) > 0.005
    assert "from another side" in alignment.motion or "turned about its optical axis" in alignment.motion


def test_views_without_overlap_determine_nothing():
    clouds, poses = views_of_a_box([np.eye(4)] * 2, eyes=[(0.0, 0.0, 0.7), (0.0, 0.0, -0.7)])
    alignment = align_views(clouds, poses)
    assert np.isnan(alignment.disagreement).all()
    assert not alignment.is_determined
    assert not alignment.disagrees
    np.testing.assert_array_equal(alignment.corrections, np.tile(np.eye(4), (2, 1, 1)))


@pytest.mark.parametrize("is_mount", [True, False])
def test_its_derivatives_are_those_of_finite_differences(is_mount):
    clouds, poses = views_of_a_box([random_motion(n, 1.0, 0.01) for n in range(6)])
    views = [_in_camera(cloud, pose) for cloud, pose in zip(clouds, poses, strict=True)]
    pairs = [(i, j) for i in range(6) for j in range(6) if i != j]
    corrections = np.stack([random_motion(20 + n, 0.5, 0.005) for n in range(6)])
    matches = _match_points(views, pairs, corrections, 0.05)
    residuals, jacobian = _linearise(views, matches, corrections, is_mount)
    assert len(residuals) > 1000
    step = 1e-6 * np.random.default_rng(0).normal(size=jacobian.shape[1])

    def moved(sign):
        steps = np.tile(step, (6, 1)) if is_mount else np.concatenate([np.zeros(6), step]).reshape(6, 6)
        there = corrections @ np.stack([_exponential(sign * one) for one in steps])
        return _linearise(views, matches, there, is_mount)[0]

    np.testing.assert_allclose(jacobian @ step, 0.5 * (moved(1.0) - moved(-1.0)), atol=1e-11)


def test_a_view_without_points_changes_nothing():
    clouds, poses = views_of_a_box(len(EYES) * [random_motion(3, 1.0, 0.005)])
    without = align_views(clouds, poses)
    blank = PointCloud(0.0 * clouds[0].points, clouds[0].normals, 0 * clouds[0].mask == 1)
    alignment = align_views([*clouds, blank], [*poses, Pose.from_matrix(np.eye(4))])
    assert np.isnan(alignment.disagreement[-1])
    np.testing.assert_allclose(alignment.corrections[0], without.corrections[0], atol=1e-9)
    with pytest.raises(InputError, match="none of the 2 clouds has a point"):
        align_views([blank, blank], poses[:2])


def test_what_cannot_be_compared_is_refused():
    clouds, poses = views_of_a_box([np.eye(4)] * 2, eyes=EYES[:2])
    with pytest.raises(InputError, match="there are 1 clouds and 2 poses: give a pose for each"):
        align_views(clouds[:1], poses)
    with pytest.raises(InputError, match="there are 1 views: only two or more can disagree"):
        align_views(clouds[:1], poses[:1])


ERROR = random_motion(3, 2.0, 0.008)
PLACES = [around(angle, elevation) for angle, elevation in ((0.2, 0.5), (0.9, 0.9), (1.6, 0.4), (2.3, 0.8))]


def off_the_sphere(session):
    """The median distance of the points from the scanned sphere."""
    points, _ = session.cloud.to_numpy()
    return np.median(np.abs(np.linalg.norm(points - np.array([0.3, 0.2, 0.101]), axis=1) - 0.1))


def test_a_session_warns_of_its_mount_once_and_corrects_it_on_request(tmp_path):
    """The cameras are rolled, because a round scene determines no shift without a rotation."""
    rolls = [Rotation.from_rotvec([0.0, 0.0, 0.7 * n]).as_matrix() for n in range(4)]
    true = [place.copy() for place in PLACES]
    for matrix, roll in zip(true, rolls, strict=True):
        matrix[:3, :3] = matrix[:3, :3] @ roll
    plain, corrected = session_of(), session_of(tmp_path, correct_mount=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for matrix in true:
            plain.add(shot(matrix), matrix @ np.linalg.inv(ERROR), depth_scale=1e-3)
    (said,) = [str(one.message) for one in caught if "disagree" in str(one.message)]
    assert re.search(r"views disagree by .* the camera's mount seems off by .*Session\(correct_mount=True\)", said)
    for matrix in true:
        corrected.add(shot(matrix), matrix @ np.linalg.inv(ERROR), depth_scale=1e-3)
    assert off_the_sphere(corrected) < 0.5 * off_the_sphere(plain)
    # The folder holds the poses that were passed in.
    again = type(corrected).load(tmp_path)
    np.testing.assert_allclose(again.cloud.points, corrected.cloud.points, atol=1e-5)
    # The proposed pose includes the error of the mount.
    sent, planned = corrected.next().matrix, corrected.frame.to_world(corrected.next().proposal.pose).to_matrix()
    np.testing.assert_allclose(sent @ corrected.alignment.corrections[0], planned, atol=1e-5)


def test_comparing_views_warns_once():
    """Pixels of 10 m mark missing values, which is warned of once for each image."""
    session = session_of()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for matrix in PLACES[:3]:
            image = shot(matrix)
            image[:8] = 10_000
            session.add(image, matrix, depth_scale=1e-3)
    assert sum("as no measured surface would" in str(one.message) for one in caught) == 3
    assert not any("disagree" in str(one.message) for one in caught)
