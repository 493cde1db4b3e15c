"""Images in which some pixels show the object, and others show things beside it."""

import numpy as np
import pytest
from opencv_lens import undistort
from small_session import FIRST, POSES, planner_of, session_of, shot

import jaxnbv as nbv
from jaxnbv.planning.images import Image, only_where


def left_half(image):
    mask = np.zeros(image.shape, bool)
    mask[:, :34] = True
    return mask


def test_points_are_those_of_the_mask(tmp_path):
    """A mask gives the points of the whole image where it is true. A stored session is the same."""
    planner = planner_of(capacity=4000)
    whole, masked = session_of(planner=planner), session_of(tmp_path, planner=planner)
    image = shot(FIRST)
    whole.add(image, FIRST, 1e-3)
    masked.add(image, FIRST, 1e-3, left_half(image))
    points, masked_points = (np.asarray(session.cloud.to_numpy()[0], np.float64) for session in (whole, masked))
    local = (points - FIRST[:3, 3]) @ FIRST[:3, :3]
    column = whole.camera.to_pixels(local[:, :2] / local[:, 2:])[:, 0]
    # Points come from fitted planes, and may cross the middle by less than a pixel.
    expected = int(np.sum(np.asarray(column) < 34.0))
    assert len(masked_points) == pytest.approx(expected, abs=4)
    assert 0 < len(masked_points) < len(points)
    # Rays to other things end all the same.
    assert np.array_equal(np.asarray(masked.observations.looks.sight), np.asarray(whole.observations.looks.sight))
    again = nbv.Session.load(tmp_path, progress=False)
    assert np.array_equal(again.cloud.to_numpy()[0], masked.cloud.to_numpy()[0])


def test_ignored_points_are_no_part_of_the_object():
    """One half of the world counts as the robot."""

    def is_robot(points):
        return points[:, 0] > 0.3

    plain, session, image = session_of(), session_of(ignore=is_robot), shot(FIRST)
    plain.add(image, FIRST, 1e-3)
    session.add(image, FIRST, 1e-3)
    points, rest = plain.cloud.to_numpy()[0], session.cloud.to_numpy()[0]
    # A pixel is 7 mm there, and points come from fitted planes.
    assert rest[:, 0].max() < 0.307
    inside = points[points[:, 0] < 0.293]
    assert np.abs(inside[:, None] - rest[None]).max(axis=-1).min(axis=1).max() < 1e-6
    # Rays to the robot end all the same.
    assert np.array_equal(np.asarray(session.observations.looks.sight), np.asarray(plain.observations.looks.sight))
    with pytest.raises(nbv.InputError, match=r"ignore returned .* points: return a bool for each"):
        session_of(ignore=lambda points: points).add(image, FIRST, 1e-3)


def test_the_robot_is_where_it_was_when_the_image_was_taken(tmp_path):
    """Images that are added again, after loading or with corrected poses, show the robot at its place at that time."""
    edge = [0.3]
    session = session_of(tmp_path, ignore=lambda points: points[:, 0] > edge[0])
    session.add(shot(FIRST), FIRST, 1e-3)
    edge[0] = 0.0
    again = nbv.Session.load(tmp_path, progress=False, ignore=session.ignore)
    np.testing.assert_array_equal(again.cloud.to_numpy()[0], session.cloud.to_numpy()[0])


def test_masks_of_another_size_or_of_nothing_are_refused():
    session, image = session_of(), shot(FIRST)
    for mask in (np.ones((4, 4), bool), np.ones((48, 64))):
        with pytest.raises(nbv.InputError, match="the mask is"):
            session.add(image, FIRST, 1e-3, mask)
    with pytest.raises(nbv.InputError, match="at the pixels of the mask"):
        session.add(image, FIRST, 1e-3, np.zeros(image.shape, bool))
    assert len(session.views) == 0
    session.add(image, FIRST, 1e-3)
    session.add(shot(POSES[1]), POSES[1], 1e-3, np.zeros(image.shape, bool))
    with pytest.raises(nbv.InputError, match="knows no parts"):
        session.identity  # noqa: B018


def test_masks_and_robots_are_seen_through_the_lens():
    """The mask and the robot are the ball's pixels in the raw image, by rays that NumPy undistorts."""
    lens = (0.2, 0.02, 0.001, -0.001, 0.0)
    camera = nbv.Camera(fov=1.0, height=120, width=160, distortion=lens)
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics
    column, row = np.meshgrid(np.arange(160), np.arange(120))
    ideal = undistort(np.stack([(column - cx) / fx, (row - cy) / fy], axis=-1), lens)
    rays = np.concatenate([ideal, np.ones((120, 160, 1))], axis=-1)
    # A ball of 0.3 beside the axis, 1.5 m ahead, before a wall at 2 m.
    center = np.array([0.5, 0.3, 1.5])
    along, squared = rays @ center, (rays**2).sum(axis=-1)
    root = along**2 - squared * (center @ center - 0.3**2)
    on_ball = root > 0
    depth = np.where(on_ball, (along - np.sqrt(np.maximum(root, 0.0))) / squared, 2.0)
    image, pose = Image.from_arrays(depth, np.eye(4), 1.0, None), nbv.Pose.from_matrix(np.eye(4))
    np.testing.assert_allclose(image.points(camera, pose), depth[..., None] * rays, atol=1e-6)

    def away(cloud):
        return np.abs(np.linalg.norm(cloud.to_numpy()[0] - center, axis=1) - 0.3)

    cloud = image.cloud(camera, pose, 1)
    ball = only_where(cloud, on_ball, camera, 1)
    # Pixels at the border may show either.
    assert (away(ball) > 0.01).mean() < 0.03
    assert (away(ball) < 0.01).sum() > 0.97 * (away(cloud) < 0.01).sum()
    without = image.with_robot(
        lambda points: np.abs(np.linalg.norm(points - center, axis=1) - 0.3) < 1e-3, camera, pose
    )
    np.testing.assert_array_equal(without.robot, on_ball)
    assert (away(without.cloud(camera, pose, 1)) < 0.01).sum() < 0.03 * on_ball.sum()
