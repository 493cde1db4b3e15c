"""Frames: world and scene coordinates, and the upward axis."""

import jax
import numpy as np
import pytest
import trimesh

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
UPS = [*AXES, *(f"-{axis}" for axis in AXES)]


def test_frame_centres_the_box_and_scales_its_longest_side():
    world = np.array([[10.0, 0.0, -3.0], [14.0, 1.0, -1.0], [12.0, 0.5, -2.9]])
    frame = nbv.Frame.fit(world)
    scene = frame.to_scene(world)
    np.testing.assert_allclose(scene.min(axis=0), [-1.25, -0.3125, -0.625], atol=1e-12)
    np.testing.assert_allclose(scene.max(axis=0), [1.25, 0.3125, 0.625], atol=1e-12)
    np.testing.assert_allclose(frame.to_world(scene), world, atol=1e-12)
    assert nbv.Frame.fit(world, longest_side=1.0).scale == pytest.approx(0.25)


@pytest.mark.parametrize("up", UPS)
def test_up_is_the_scene_s_y_by_a_rotation(up):
    frame = nbv.Frame(2.0, (1.0, 2.0, 3.0), up)
    axis = np.array(AXES[up[-1]], float) * (-1.0 if up.startswith("-") else 1.0)
    np.testing.assert_array_equal(frame.rotation @ axis, [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(frame.rotation @ frame.rotation.T, np.eye(3))
    assert np.linalg.det(frame.rotation) == 1.0
    np.testing.assert_allclose(frame.to_scene(np.array([1.0, 2.0, 3.0]) + 0.5 * axis), [0.0, 1.0, 0.0], atol=1e-12)
    world = np.random.default_rng(0).normal(size=(7, 3))
    np.testing.assert_allclose(frame.to_world(frame.to_scene(world)), world, atol=1e-12)


@pytest.mark.parametrize("up", ["y", "-z"])
def test_what_a_sensor_sees_in_the_world_is_what_it_sees_in_the_scene(up):
    """A depth image with its camera, pose and box maps to the scene before or after it becomes a cloud."""
    frame = nbv.Frame(0.01, (50.0, -20.0, 30.0), up)
    camera = nbv.Camera(0.6, 12, 14, nearest=150.0, farthest=260.0)
    pose = nbv.look_at((50.0, 90.0, 190.0), (48.0, -18.0, 31.0), up=(0.1, 0.9, 0.3))
    box = nbv.Box((0.0, -60.0, -20.0), (75.0, 30.0, 80.0))
    ball = nbv.SDFSurface(Sphere(45.0).translate([50.0, -20.0, 30.0]), bounding_radius=400.0)
    cloud = nbv.scan(ball, camera, pose)
    depth = np.where(
        cloud.mask, (np.asarray(cloud.points) - np.asarray(pose.position)) @ np.asarray(pose.forward), np.inf
    )
    depth = depth.reshape(12, 14)
    world = frame.to_scene(nbv.PointCloud.from_depth(depth, camera, pose, box=box))
    moved = frame.to_scene(camera), frame.to_scene(pose)
    scene = nbv.PointCloud.from_depth(depth, *moved, depth_scale=0.01, box=frame.to_scene(box))
    assert int(scene.count) > 20
    np.testing.assert_array_equal(world.mask, scene.mask)
    np.testing.assert_array_equal(world.missed, scene.missed)
    np.testing.assert_allclose(world.points, scene.points, atol=2e-5)
    np.testing.assert_allclose(world.normals, scene.normals, atol=2e-4)
    for thing, other in ((camera, moved[0]), (pose, moved[1]), (box, frame.to_scene(box))):
        for a, b in zip(jax.tree.leaves(frame.to_world(other)), jax.tree.leaves(thing), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-3)
    assert frame.to_world(moved[0]).farthest == pytest.approx(260.0)
    assert frame.to_world(frame.to_scene(box)).low == pytest.approx(box.low)


def test_a_mesh_of_another_up_stands_upright(tmp_path):
    trimesh.creation.cylinder(0.1, 2.0).export(tmp_path / "pole.ply")
    for up, expected in (("z", 1), ("y", 2)):
        vertices = nbv.load_mesh(tmp_path / "pole.ply", up).vertices
        assert np.argmax(np.ptp(vertices, axis=0)) == expected
    with pytest.raises(nbv.InputError, match="up is 'north'; give one of y, -y"):
        nbv.load_mesh(tmp_path / "pole.ply", "north")
