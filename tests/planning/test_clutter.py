"""Clutter around the box of a session, from its images."""

import numpy as np
import pytest
from small_session import CAMERA, CENTER, FIRST, POSES, around, session_of

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.clutter import Clutter
from jaxnbv.planning.images import Image
from jaxnbv.scanning import Obstacles, SDFSurface, scan
from jaxnbv.scanning.sdf import Cuboid, Sphere

EYE = Camera(fov=1.0, height=240, width=320)
SMALL = Box((-0.3,) * 3, (0.3,) * 3)
# Half a metre in front of the box, as seen from the camera.
POST = Cuboid([0.03, 0.03, 0.3]).translate([0.3, -0.1, 0.15])


def image_of(depth, pose):
    return Image.from_arrays(depth, np.asarray(pose.matrix, np.float64), 1.0, None)


def voted(clutter, depth, pose, robot=None):
    return clutter.with_image(image_of(depth, pose)._replace(robot=robot), EYE, pose, Frame(), Obstacles())


@pytest.fixture(scope="module")
def wall():
    """Votes for a wall at z = -1.04, in the middle of a layer of cells, seen from z = 2 past an empty box."""
    pose = look_at((0.0, 0.0, 2.0))
    return voted(Clutter.empty(2.0, SMALL), np.full((240, 320), 3.04), pose), pose


def test_cells_of_a_wall_are_at_its_distance(wall):
    clutter, _ = wall
    solid, cell = clutter.solid(), clutter.spacing
    assert cell == pytest.approx(4.0 / 48)
    points = np.random.default_rng(0).uniform([-1.0, -1.0, -0.9], [1.0, 1.0, 1.9], (200, 3))
    distance = np.asarray(solid(points), np.float64)
    # The near face of the layer is half a cell before the wall, and hits on faces of cells are accurate to half a cell.
    assert np.abs(distance - (points[:, 2] + 1.04 - 0.5 * cell)).max() < 0.6 * cell
    assert (np.asarray(solid(np.array([[0.0, 0.0, -1.04], [0.5, 0.3, -1.04]]))) < 0).all()


def test_cells_that_a_later_image_sees_through_are_free(wall):
    clutter, pose = wall
    assert (clutter.votes[12:36, 12:36, 11] == 1).all()
    behind = voted(clutter, np.full((240, 320), 3.5), pose)
    # Away from the border of the image, cells of the first wall have as many votes for free as for occupied. The second
    # wall is at z = -1.5.
    assert (behind.votes[12:36, 12:36, 11] == 0).all()
    assert ((behind.votes[12:36, 12:36] > 0).sum(axis=2) <= 2).all()
    assert ((behind.votes[12:36, 12:36, 5:7] > 0).any(axis=2)).all()
    # Pixels without a measurement give no votes.
    nothing = voted(clutter, np.zeros((240, 320)), pose)
    np.testing.assert_array_equal(nothing.votes, clutter.votes)


def test_neither_the_object_nor_a_table_nor_the_robot_is_clutter():
    pose, empty = look_at((0.0, 0.0, 2.0)), Clutter.empty(2.0, SMALL)
    in_box = voted(empty, np.full((240, 320), 2.0), pose)
    inside = np.abs((np.arange(48) + 0.5) * empty.spacing - 2.0) < 0.3
    assert (in_box.votes[np.ix_(inside, inside, inside)] == 0).all()
    assert in_box.solid() is not None
    table = Obstacles((Cuboid([3.0, 3.0, 0.1]).translate([0.0, 0.0, -1.1]),))
    wall = image_of(np.full((240, 320), 3.0), pose)
    assert empty.with_image(wall, EYE, pose, Frame(), table).solid() is None
    assert voted(empty, np.full((240, 320), 3.0), pose, np.ones((240, 320), bool)).solid() is None


def shot_of(world, matrix):
    pose = Pose.from_matrix(matrix)
    cloud = scan(SDFSurface(world), CAMERA, pose)
    depth = (np.asarray(cloud.points, np.float64) - np.asarray(pose.position)) @ np.asarray(pose.forward, np.float64)
    return np.where(cloud.mask, depth, 0.0).reshape(48, 64)


WORLD = Sphere(0.1).translate([0.3, 0.2, 0.101]) | Cuboid([1.0, 1.0, 0.02]).translate([0.3, 0.2, -0.021]) | POST
BESIDE = around(-0.9, 0.5, 0.7)
# At the face of the post, and behind the post as seen from the object.
AT_POST = np.asarray(look_at((0.335, -0.1, 0.25), CENTER, up=(0.0, 0.0, 1.0)).matrix, np.float64)
BEHIND = np.asarray(look_at((0.3, -0.4, 0.16), CENTER, up=(0.0, 0.0, 1.0)).matrix, np.float64)


def test_a_post_beside_the_box_hides_it_and_keeps_cameras_away():
    """Unless it is ignored as the robot."""

    def is_post(points):
        return np.abs(points - [0.3, -0.1, 0.15]).max(axis=1) < 0.32

    poses = np.stack([AT_POST, BEHIND, *POSES])
    sessions = [
        session_of(obstacles=None, poses=poses, ignore=ignore)
        for ignore in (lambda points: np.zeros(len(points), bool), is_post)
    ]
    for session in sessions:
        with pytest.warns(UserWarning, match="taken for a table"):
            session.add(shot_of(WORLD, BESIDE), BESIDE)
    session, clutter = sessions[0], sessions[0].planner.obstacles.clutter
    values, without_post = (np.asarray(session.next().proposal.values) for session in sessions)
    assert sessions[1].planner.obstacles.clutter is None
    assert np.isfinite(without_post).all()
    scale = float(session.frame.scale)
    places = np.asarray(session.frame.to_scene(np.array([[0.33, -0.1, 0.2], [0.5, -0.1, 0.2], FIRST[:3, 3]])))
    at_face, beside, far = np.asarray(clutter(places), np.float64) / scale
    cell = session._intake.clutter.spacing / scale
    assert at_face < 0.5 * cell
    # By the distances of the solid itself, to a cell.
    for distance, place in ((beside, [0.5, -0.1, 0.2]), (far, FIRST[:3, 3])):
        assert distance == pytest.approx(float(POST(np.asarray(place))), abs=1.5 * cell)
    assert values[0] == -np.inf
    assert values[1] < 0.7 * without_post[1]


def test_obstacles_of_the_user_replace_clutter():
    session = session_of(obstacles=Obstacles())
    session.add(shot_of(WORLD, BESIDE), BESIDE)
    assert session.planner.obstacles.clutter is None
