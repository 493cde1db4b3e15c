"""Camera, poses, look_at and the Fibonacci sphere, against trigonometry by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at

coordinate = st.floats(-3.0, 3.0, width=32)
vector = st.tuples(coordinate, coordinate, coordinate)


def angle(a, b):
    return math.acos(np.clip(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0))


def test_field_of_view_is_the_vertical_angle_between_the_images_edges():
    """The centres of the first and last of n rows lie at the share (n - 1)/n of the edges' tangent."""
    camera = Camera(fov=math.radians(30.0), height=50, width=9)
    _, rays = camera.rays(look_at((0.0, 0.0, 2.5)))
    rays = np.asarray(rays, dtype=np.float64).reshape(50, 9, 3)
    expected = 2 * math.atan(49 / 50 * math.tan(math.radians(15.0)))
    assert angle(rays[0, 4], rays[-1, 4]) == pytest.approx(expected, abs=1e-5)
    expected = 2 * math.atan(8 / 50 * math.tan(math.radians(15.0)))  # eight square pixels across
    a, b = rays[24, 0] + rays[25, 0], rays[24, 8] + rays[25, 8]
    assert angle(a, b) == pytest.approx(expected, abs=1e-5)


def test_rays_leave_the_sensor_with_unit_length_and_the_middle_one_goes_forward():
    camera, pose = Camera(height=5, width=7), look_at((0.8, 0.9, 2.2), target=(0.1, -0.2, 0.3))
    origins, directions = camera.rays(pose)
    assert origins.shape == directions.shape == (35, 3) == (camera.num_rays, 3)
    np.testing.assert_allclose(origins, np.tile([0.8, 0.9, 2.2], (35, 1)), atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(directions[17], pose.forward, atol=1e-6)


def test_look_at_axes_are_those_of_opencv():
    pose = look_at((0.0, 0.0, 2.5))
    np.testing.assert_allclose(pose.rotation, [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], atol=1e-7)
    np.testing.assert_allclose(pose.to_scene(jnp.array([[0.5, 0.25, 2.0]])), [[0.5, -0.25, 0.5]], atol=1e-6)
    pose = look_at((3.0, 0.0, 0.0), target=(1.0, 0.0, 0.0), up=(0.0, 0.0, 2.0))
    np.testing.assert_allclose(pose.rotation.T, [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], atol=1e-7)


@settings(max_examples=100, deadline=None)
@given(vector, vector, vector)
def test_look_at_is_a_rotation_that_faces_its_target_with_up_above(position, target, up):
    position, target, up = (np.asarray(v, dtype=np.float32).astype(np.float64) for v in (position, target, up))
    offset = target - position
    assume(np.linalg.norm(offset) > 0.1)
    assume(np.linalg.norm(up) > 0.1)
    pose = look_at(position, target, up)
    rotation = np.asarray(pose.rotation, dtype=np.float64)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-5)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)
    right, down, forward = rotation.T
    np.testing.assert_allclose(forward, offset / np.linalg.norm(offset), atol=1e-5)
    sine = np.linalg.norm(np.cross(forward, up)) / np.linalg.norm(up)
    if sine > 0.01:
        assert down @ up < 0
        assert abs(right @ up) < 1e-4 * np.linalg.norm(up)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("tilt", [0.0, 1e-7, 1e-5, 1e-3])
def test_looking_along_up_is_defined(side, tilt):
    rotation = np.asarray(look_at((tilt, 2.5 * side, 0.0)).rotation)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(rotation[:, 2], [-tilt / 2.5, -side, 0.0], atol=1e-5)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-5)


def test_batches_equal_single_poses():
    positions = np.random.default_rng(0).normal(size=(2, 3, 3))
    camera, poses = Camera(height=3, width=4), look_at(positions)
    origins, directions = camera.rays(poses)
    assert poses.rotation.shape == (2, 3, 3, 3)
    assert directions.shape == (2, 3, 12, 3)
    for i in np.ndindex(2, 3):
        alone = look_at(positions[i])
        np.testing.assert_allclose(poses[i].rotation, alone.rotation, atol=1e-6)
        np.testing.assert_allclose(poses[i].forward, alone.forward, atol=1e-6)
        for batched, single in zip((origins[i], directions[i]), camera.rays(alone), strict=True):
            np.testing.assert_allclose(batched, single, atol=1e-6)


def test_look_at_and_rays_run_under_jit_and_are_differentiable():
    camera = Camera(height=2, width=3)

    def last_ray(position):
        return camera.rays(look_at(position))[1][-1]

    position = jnp.array([0.8, 0.9, 2.2])
    np.testing.assert_allclose(jax.jit(last_ray)(position), last_ray(position), atol=1e-6)
    jacobian = jax.jacobian(last_ray)(position)
    for i in range(3):
        step = jnp.zeros(3).at[i].set(1e-2)
        difference = (last_ray(position + step) - last_ray(position - step)) / 2e-2
        np.testing.assert_allclose(jacobian[:, i], difference, atol=1e-4)


@pytest.mark.parametrize(
    ("rotation", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), "not a rotation"),
        (np.diag([1.0, 1.0, 1.1]), "not a rotation"),
        (np.eye(3) + np.eye(3, k=1) * 0.01, "not a rotation"),
        (np.zeros((3, 3)), "not a rotation"),
        (np.full((3, 3), np.nan), "not finite"),
    ],
)
def test_a_pose_that_is_not_a_rotation_is_refused_and_so_is_one_of_a_batch(rotation, message):
    for rotations in (rotation, np.stack([np.eye(3), np.eye(3), rotation])):
        with pytest.raises(ValueError, match=message):
            Pose(rotations, np.zeros(rotations.shape[:-1]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((1.0, 2.0, 3.0), (1.0, 2.0, 3.0)), "apart from its target"),
        (((np.nan, 0.0, 1.0),), "finite"),
        (((0.0, 0.0, 1e30),), r"distance from its target is a finite number, got position \[0"),
        (((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "up direction"),
    ],
)
def test_look_at_without_a_direction_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        look_at(*arguments)


@pytest.mark.parametrize("count", [12, 120, 1000])
def test_fibonacci_sphere_is_even(count):
    """Nearest neighbours against Fejes Toth's bound, which no set of n points on the sphere can exceed."""
    points = np.asarray(fibonacci_sphere(count, 2.5), dtype=np.float64)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.5, atol=1e-5)
    unit = points / 2.5
    distance = np.linalg.norm(unit[:, None] - unit[None], axis=-1) + 9 * np.eye(count)
    bound = math.sqrt(4 - 1 / math.sin(math.pi * count / (6 * (count - 2))) ** 2)
    assert 0.8 * bound < distance.min() <= bound
    assert np.linalg.norm(unit.mean(axis=0)) < 2 / count
    # No hole: any direction has a point within the distance at which the bound's neighbours lie.
    probes = np.random.default_rng(1).normal(size=(2000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    assert np.linalg.norm(probes[:, None] - unit[None], axis=-1).min(axis=1).max() < bound


@pytest.mark.parametrize(("count", "radius"), [(0, 1.0), (-3, 1.0), (5, 0.0), (5, -1.0)])
def test_fibonacci_sphere_refuses_nothing(count, radius):
    with pytest.raises(ValueError, match=r"Fibonacci|radius"):
        fibonacci_sphere(count, radius)


def test_a_batch_of_poses_is_iterated_once():
    poses = look_at(fibonacci_sphere(3, 2.5))
    for pose, again in zip(poses, [poses[0], poses[1], poses[-1]], strict=True):
        np.testing.assert_array_equal(pose.position, again.position)
    assert [len(list(row)) for row in look_at(np.ones((2, 3, 3)))] == [3, 3]
