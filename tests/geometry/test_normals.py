"""Normals of plain points against those of their surface; planes through the noise of a depth image: the noise that
is found, and what it leaves of normals and depths."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.geometry.plane_fit import depth_noise

CENTRES = np.asarray(nbv.geometry.fibonacci_sphere(3000), np.float64)


def angles(found, expected):
    return np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=1), -1.0, 1.0)))


def test_normals_of_a_ball_are_its_radii_and_face_each_points_own_sensor():
    """Within a patch of 16 of 3,000 points, 0.073 in radius, a ball turns by four degrees."""
    found = nbv.geometry.estimate_normals(0.7 * CENTRES, 3.0 * CENTRES)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-9)
    assert np.percentile(angles(found, CENTRES), 99) < 2.0
    inward = nbv.geometry.estimate_normals(0.7 * CENTRES, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(inward, -found, atol=1e-9)


def test_more_neighbours_smooth_noise():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (4000, 2)), 0.02 * rng.normal(size=(4000, 1))], axis=1)
    up = np.array([[0.0, 0.0, 1.0]])
    few, many = (np.median(angles(nbv.geometry.estimate_normals(points, (0, 0, 5.0), k), up)) for k in (8, 64))
    assert many < 0.3 * few
    assert many < 3.0


# A ball of 8 cm before a slanted plane, 0.45 m away: in metres, as a sensor of 640 x 480 pixels sees its middle.
CAMERA = nbv.Camera.from_intrinsics([[570.0, 0.0, 99.5], [0.0, 570.0, 79.5], [0.0, 0.0, 1.0]], 160, 200)
POSE = nbv.look_at((0.03, 0.0, 0.45))
RADIUS = 0.08
SLANTED, BEHIND = np.array([0.3, -0.2, 1.0]) / np.sqrt(1.13), -0.05


def ball_and_plane():
    """Depth and outward normals, from the equations, in float64."""
    rays = np.asarray(CAMERA.pixel_directions(), np.float64) @ np.asarray(POSE.rotation, np.float64).T
    origin, forward = np.asarray(POSE.position, np.float64), np.asarray(POSE.forward, np.float64)
    plane = (BEHIND - origin @ SLANTED) / (rays @ SLANTED)
    a, b, c = (rays**2).sum(axis=1), rays @ origin, origin @ origin - RADIUS**2
    inside = b**2 - a * c
    ball = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)
    distance = np.minimum(ball, plane)
    normals = np.where((ball < plane)[:, None], (origin + distance[:, None] * rays) / RADIUS, SLANTED)
    shape = CAMERA.height, CAMERA.width
    return (distance * (rays @ forward)).reshape(shape), normals.reshape(*shape, 3)


def image(noise, seed=0):
    """In whole millimetres."""
    depth, _ = ball_and_plane()
    noisy = depth + noise * np.random.default_rng(seed).normal(size=depth.shape)
    return np.round(1000.0 * noisy).astype(np.uint16)


@pytest.mark.parametrize("noise", [1e-3, 2e-3, 5e-3])
def test_the_noise_of_an_image_is_found(noise):
    """30,000 third differences: the tolerance is a tenth, for the surface bends."""
    depth = jnp.asarray(1e-3 * image(noise))
    found = float(depth_noise(depth, depth > 0))
    assert found == pytest.approx(np.hypot(noise, 1e-3 / np.sqrt(12)), rel=0.1)


def test_an_image_without_four_pixels_in_a_row_has_no_noise():
    assert float(depth_noise(jnp.ones((5, 3)), jnp.ones((5, 3), bool))) == 0.0
    assert float(depth_noise(jnp.ones((5, 8)), jnp.zeros((5, 8), bool))) == 0.0


@pytest.mark.parametrize(
    ("noise", "median", "most"),
    [(0.0, 2.5, 9.0), (1e-3, 4.5, 14.0), (2e-3, 8.0, 20.0)],
    ids=["rounded", "1 mm", "2 mm"],
)
@pytest.mark.parametrize("stride", [1, 4])
def test_normals_see_through_the_noise(noise, median, most, stride):
    """Degrees, half and nine tenths of the pixels; the edge of the ball among them. Depths are better than measured."""
    depth, normals = ball_and_plane()
    rows = slice(stride // 2, None, stride)
    cloud = nbv.PointCloud.from_depth(image(noise), CAMERA, POSE, depth_scale=1e-3, stride=stride)
    mask, truth = np.asarray(cloud.mask), normals[rows, rows].reshape(-1, 3)
    assert mask.mean() > 0.99
    cosine = np.sum(np.asarray(cloud.normals, np.float64) * truth, axis=1)[mask]
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    assert np.median(angle) < median
    assert np.quantile(angle, 0.9) < most
    measured = 1e-3 * image(noise)[rows, rows].reshape(-1)[mask] - depth[rows, rows].reshape(-1)[mask]
    position, forward = np.asarray(POSE.position), np.asarray(POSE.forward)
    fitted = ((np.asarray(cloud.points) - position) @ forward)[mask] - depth[rows, rows].reshape(-1)[mask]
    assert np.median(np.abs(fitted)) < 0.6 * np.median(np.abs(measured))
