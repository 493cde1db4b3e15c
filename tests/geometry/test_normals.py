"""Normals of plain points against those of their surface; planes fitted to noisy depth images: the estimated noise, and
the errors that remain in normals and depths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.geometry.depth_noise import depth_noise

NOISE = jax.jit(depth_noise)
CENTRES = np.asarray(nbv.geometry.fibonacci_sphere(3000), np.float64)


def angles(vectors, expected):
    return np.degrees(np.arccos(np.clip(np.sum(vectors * expected, axis=1), -1.0, 1.0)))


def test_normals_of_a_ball_are_its_radii_and_face_each_points_own_sensor():
    """Within a patch of 16 of 3,000 points (radius 0.073) the normal of a ball turns by four degrees."""
    normals = nbv.geometry.estimate_normals(0.7 * CENTRES, 3.0 * CENTRES)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    assert np.percentile(angles(normals, CENTRES), 99) < 2.0
    inward = nbv.geometry.estimate_normals(0.7 * CENTRES, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(inward, -normals, atol=1e-9)


def test_more_neighbours_smooth_noise():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (4000, 2)), 0.02 * rng.normal(size=(4000, 1))], axis=1)
    up = np.array([[0.0, 0.0, 1.0]])
    few, many = (np.median(angles(nbv.geometry.estimate_normals(points, (0, 0, 5.0), k), up)) for k in (8, 64))
    assert many < 0.3 * few
    assert many < 3.0


# A ball of 8 cm before a slanted plane, 0.45 m away, in metres, as in the middle of a sensor's 640 x 480 pixels.
CAMERA = nbv.Camera.from_intrinsics([[570.0, 0.0, 99.5], [0.0, 570.0, 79.5], [0.0, 0.0, 1.0]], 160, 200)
POSE = nbv.look_at((0.03, 0.0, 0.45))
RADIUS = 0.08
SLANTED, BEHIND = np.array([0.3, -0.2, 1.0]) / np.sqrt(1.13), -0.05


def ball_and_plane():
    """Depth and outward normals in closed form, in float64."""
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
    """A noisy image in whole millimetres."""
    depth, _ = ball_and_plane()
    noisy = depth + noise * np.random.default_rng(seed).normal(size=depth.shape)
    return np.round(1000.0 * noisy).astype(np.uint16)


@pytest.mark.parametrize("noise", [1e-3, 5e-3])
def test_the_noise_of_an_image_is_found(noise):
    """The tolerance is that of the median of some hundred differences near a pixel, and of the surface's curvature."""
    depth = jnp.asarray(1e-3 * image(noise))
    ratio = np.asarray(NOISE(depth, depth > 0, 0.0)) / np.hypot(noise, 1e-3 / np.sqrt(12))
    assert np.median(ratio) == pytest.approx(1.0, rel=0.1)
    assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.25


def test_noise_is_local_in_image_and_depth():
    """Two walls, both with low noise on the left and high noise on the right. Their pixels are mixed, and a third
    belong to the near wall.

    Within a tile and a half of the middle the estimate may be either.
    """
    rng = np.random.default_rng(0)
    near = np.arange(160) % 15 < 5
    wall = np.where(near[:, None], 0.5, 2.0) * np.ones((160, 200))
    truth = np.where(near[:, None], 1e-3, 8e-3) * np.where(np.arange(200) < 100, 1.0, 4.0)
    depth = jnp.asarray(wall + truth * rng.normal(size=wall.shape))
    ratio = np.asarray(NOISE(depth, depth > 0, 0.0)) / truth
    away = np.abs(np.arange(200) - 100) > 16
    assert np.quantile(np.abs(np.log(ratio[:, away])), 0.95) < 0.3


def test_correlated_errors_do_not_hide_noise():
    """Each error is averaged with those of the next pixels, as by a sensor that smooths. The estimate is less than for
    independent errors, but more than half."""
    rng = np.random.default_rng(0)
    independent = 1e-3 * rng.normal(size=(161, 201))
    smoothed = 0.25 * sum(independent[down : 160 + down, right : 200 + right] for down in (0, 1) for right in (0, 1))
    depth = jnp.asarray(1.0 + smoothed)
    assert np.median(NOISE(depth, depth > 0, 0.0)) == pytest.approx(smoothed.std(), rel=0.1)


def test_steps_of_depth_are_noise():
    """The depth of a slope changes in steps of 1 cm, each over a dozen pixels, so most differences are zero."""
    slope = 2.0 + 0.01 * np.floor(np.arange(200) / 12.0) * np.ones((160, 1))
    noise = NOISE(jnp.asarray(slope), jnp.ones(slope.shape, bool), 0.0)
    assert np.median(noise) == pytest.approx(0.01 / np.sqrt(12), rel=0.5)


@pytest.mark.parametrize("shape", [(5, 3), (160, 200)])
def test_an_image_without_four_pixels_in_a_row_has_no_noise_but_that_of_rounding(shape):
    apart = np.zeros(shape, bool)
    apart[::3, ::4] = True
    for valid in (apart, np.zeros(shape, bool)):
        np.testing.assert_array_equal(NOISE(jnp.ones(shape), jnp.asarray(valid), 0.25), 0.25)


@pytest.mark.parametrize("wall", [0.75, 4.0])
def test_a_noisy_background_does_not_blur_what_is_before_it(wall):
    """A ball of 8 cm at 0.57 m before a wall over most of the image, with noise that grows as the square of the depth.
    Compares with the ball's equation, and with the image without a wall."""
    camera = nbv.Camera.from_intrinsics([[570.0, 0.0, 319.5], [0.0, 570.0, 239.5], [0.0, 0.0, 1.0]], 480, 640)
    pose = nbv.look_at((0.03, 0.0, 0.57))
    ball = nbv.scan(nbv.SDFSurface(nbv.scanning.sdf.Sphere(RADIUS)), camera, pose)
    on_ball = np.asarray(ball.mask).reshape(480, 640)
    along = (np.asarray(ball.points) - np.asarray(pose.position)) @ np.asarray(pose.forward)
    truth = np.where(on_ball, along.reshape(480, 640), wall)
    noisy = truth + 2.5e-3 * truth**2 * np.random.default_rng(0).normal(size=truth.shape)
    clouds = {}
    for name, depth in (("alone", np.where(on_ball, noisy, 0.0)), ("before", noisy)):
        cloud = nbv.PointCloud.from_depth(np.round(1e3 * depth).astype(np.uint16), camera, pose, 1e-3, stride=8)
        mask = np.asarray(cloud.mask) & on_ball[4::8, 4::8].reshape(-1)
        points, normals = np.asarray(cloud.points)[mask], np.asarray(cloud.normals)[mask]
        away = np.linalg.norm(points, axis=1)
        clouds[name] = np.median(np.abs(away - RADIUS)), np.quantile(angles(normals, points / away[:, None]), 0.9)
        assert mask.sum() > 0.99 * on_ball[4::8, 4::8].sum()
    np.testing.assert_allclose(clouds["before"], clouds["alone"], rtol=0.1)
    assert clouds["before"][0] < 2.3e-4
    assert clouds["before"][1] < 4.0


@pytest.mark.parametrize(
    ("noise", "median", "most"),
    [(0.0, 2.5, 9.0), (1e-3, 4.5, 14.0), (2e-3, 8.0, 20.0)],
    ids=["rounded", "1 mm", "2 mm"],
)
def test_normals_are_accurate_despite_noise(noise, median, most):
    """Errors in degrees at half and nine tenths of the pixels, including the edge of the ball. Fitted depths are better
    than measured ones."""
    depth, normals = ball_and_plane()
    rows = slice(1, None, 3)
    cloud = nbv.PointCloud.from_depth(image(noise), CAMERA, POSE, depth_scale=1e-3, stride=3)
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
