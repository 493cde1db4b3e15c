"""The scanner: rows, batches of poses, sensor noise by its law and by statistics, depth images, and the distance at
which an object fits into the image."""

import dataclasses
import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.scanning.sensors import USUAL_SETTING, fit_distance
from jaxnbv.studies.sensors import HEAT_SETTING, PART_SETTING

ICOSPHERE = trimesh.creation.icosphere(4)
SURFACES = {
    "sdf": nbv.SDFSurface(Sphere(0.6).translate([0.2, 0.1, 0.0])),
    "mesh": nbv.TriangleMesh.from_arrays(ICOSPHERE.vertices, ICOSPHERE.faces),
}


@pytest.mark.parametrize("name", SURFACES)
def test_batched_poses_equal_single_ones(name):
    camera, poses = nbv.Camera(height=12, width=17), nbv.look_at(nbv.geometry.fibonacci_sphere(6, 2.5))
    batch = nbv.scan(SURFACES[name], camera, poses)
    assert batch.points.shape == (6, 12 * 17, 3)
    for i in range(6):
        alone = nbv.scan(SURFACES[name], camera, poses[i])
        assert bool((alone.mask == batch.mask[i]).all())
        np.testing.assert_allclose(alone.points, batch.points[i], atol=1e-5)
        np.testing.assert_allclose(alone.normals, batch.normals[i], atol=1e-4)


def test_a_scan_of_nothing_in_other_units_warns():
    """A scan that sees nothing warns. A large world that is visible does not."""
    camera = nbv.Camera(height=4, width=4)
    far = nbv.look_at([[0.0, 0.0, 2500.0], [0.0, 0.0, 2.5]])
    with pytest.warns(UserWarning, match="sees nothing: a camera stands 2500 scene units .* Frame.to_scene"):
        nbv.scan(nbv.SDFSurface(Sphere(0.6)), camera, far[0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nbv.scan(nbv.SDFSurface(Sphere(0.6)), camera, far)
        assert nbv.scan(nbv.SDFSurface(Sphere(600.0), 700.0), camera, far[0]).mask.any()


def test_rows_are_pixels_row_by_row_and_misses_are_masked():
    """A small sphere low and right in the image fills exactly the pixels whose rays pass within its radius."""
    camera, pose = nbv.Camera(height=20, width=30, fov=0.6), nbv.look_at([0.0, 0.0, 2.5])
    centre, radius = np.array([0.4, -0.3, 0.2]), 0.2
    cloud = nbv.scan(nbv.SDFSurface(Sphere(radius).translate(centre)), camera, pose)
    focal = 10 / np.tan(0.3)
    row, column = np.mgrid[:20, :30]
    x, y = (column + 0.5 - 15) / focal, (row + 0.5 - 10) / focal
    d = np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    away = centre - [0.0, 0.0, 2.5]
    reach = np.linalg.norm(away - (d @ away)[:, None] * d, axis=1)
    np.testing.assert_array_equal(cloud.mask, reach < radius)
    assert 10 < int(cloud.count) < 300
    assert not np.asarray(cloud.points)[reach >= radius].any()


def test_noise_has_the_stated_statistics():
    n = 40_000
    normals = np.tile([0.0, 0.6, 0.8], (n, 1))
    clean = nbv.PointCloud.from_arrays(np.tile([0.3, -0.2, 0.5], (n, 1)), normals, capacity=n + 10)
    noisy = nbv.SensorNoise(points=0.02, normals=0.05)(clean, jax.random.key(0))
    points, turned = noisy.to_numpy()
    error = points - [0.3, -0.2, 0.5]
    # Five standard errors: sigma / sqrt(n) for a mean, sigma / sqrt(2 n) for a standard deviation.
    assert (np.abs(error.mean(axis=0)) < 5 * 0.02 / np.sqrt(n)).all()
    assert (np.abs(error.std(axis=0) - 0.02) < 5 * 0.02 / np.sqrt(2 * n)).all()
    assert (np.abs(np.corrcoef(error.T) - np.eye(3)) < 5 / np.sqrt(n)).all()
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=1e-5)
    # Errors of points and normals are independent.
    together = np.corrcoef(error.T, (turned - normals).T)[:3, 3:]
    assert (np.abs(together) < 5 / np.sqrt(n)).all()
    # Across the normal, n + eps divided by its length keeps the deviation up to a factor 1 - O(sigma^2).
    across = turned @ np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]]).T
    assert (np.abs(across.std(axis=0) / 0.05 - 1) < 5 / np.sqrt(2 * n) + 2 * 0.05**2).all()
    assert not np.asarray(noisy.points)[n:].any()
    assert not np.asarray(noisy.normals)[n:].any()
    np.testing.assert_array_equal(noisy.mask, clean.mask)


@pytest.mark.parametrize("batch", [False, True])
def test_the_ranges_of_a_noisy_scan_are_those_of_its_points(batch):
    """Exact ranges would reveal the true points."""
    pose = nbv.look_at([[0.0, 0.0, 2.5], [2.5, 0.0, 0.0]] if batch else [0.0, 0.3, 2.5])
    camera = nbv.Camera(height=12, width=12)
    clean = nbv.scan(SURFACES["sdf"], camera, pose)
    noisy = nbv.SensorNoise(0.02)(clean, jax.random.key(0), camera, pose)
    mask = np.asarray(clean.mask)
    assert 10 < mask.sum() < mask.size
    np.testing.assert_allclose(np.linalg.norm(noisy.normals, axis=-1), mask, atol=1e-5)
    away = np.linalg.norm(np.asarray(noisy.points) - np.asarray(pose.position)[..., None, :], axis=-1)
    np.testing.assert_allclose(np.asarray(noisy.sight)[mask], away[mask], rtol=1e-6)
    error = (np.asarray(noisy.sight) - np.asarray(clean.sight))[mask]
    assert 0.01 < error.std() < 0.03
    assert np.isinf(np.asarray(noisy.sight)[~mask]).all()
    # A ray that ends at a masked point saw as far as before.
    ended = dataclasses.replace(clean, mask=clean.mask & False)
    again = nbv.SensorNoise(0.02)(ended, jax.random.key(0), camera, pose)
    np.testing.assert_array_equal(again.sight, clean.sight)


def seen_share(setting, reach):
    """Share of points of a sphere about the origin that the image of every candidate contains."""
    points = np.random.default_rng(0).normal(size=(2000, 3))
    points *= reach / np.linalg.norm(points, axis=1, keepdims=True)
    inside = np.ones(len(points), bool)
    for pose in nbv.SphereCandidates(20, setting.radius).poses():
        local = (points - np.asarray(pose.position)) @ np.asarray(pose.rotation)
        column, row = setting.camera.to_pixels(local[:, :2] / local[:, 2:]).T
        inside &= (column >= 0) & (column <= setting.camera.width) & (row >= 0) & (row <= setting.camera.height)
        inside &= local[:, 2] > 0
    return inside.mean()


@pytest.mark.parametrize("setting", [USUAL_SETTING, PART_SETTING, HEAT_SETTING])
def test_all_of_an_object_is_seen_from_everywhere_and_hardly_more(setting):
    distance = fit_distance(setting, 1.7)
    assert seen_share(distance, 1.7) == 1.0
    assert seen_share(distance, 1.7 * 1.06) < 1.0
    assert distance._replace(radius=setting.radius) == setting
    # A ray along the silhouette touches the ball, with 5 % of room, at the angle arcsin(reach / radius) to the axis.
    assert distance.radius * math.sin(0.5 * setting.camera.fov) == pytest.approx(1.05 * 1.7, rel=1e-5)


KEY = jax.random.key(0)
COUNT = 20_000


@pytest.mark.parametrize(
    ("noise", "at_a_metre", "step"),
    [
        (nbv.DepthNoise.kinect_v1(), 1.425e-3, 2.85e-3),
        # 0.08 pixels, and 1/32 of a pixel, for 424 pixels x 0.05 m.
        (nbv.DepthNoise.realsense_d435(), 0.08 / 21.2, 1 / 32 / 21.2),
    ],
)
def test_noise_and_steps_grow_with_the_square_of_the_depth(noise, at_a_metre, step):
    for depth in (0.7, 2.0, 4.0):
        depths = np.asarray(noise.apply(jnp.full(COUNT, depth), KEY), np.float64)
        # Rounding adds a twelfth of its square. The deviation has a standard error of 0.5 %, and its mean one of 0.7 %
        # of the deviation. 1/z is not linear, which adds (deviation / z)^2 z to the mean.
        spread = depth**2 * np.hypot(at_a_metre, step / np.sqrt(12.0))
        assert depths.std() == pytest.approx(spread, rel=0.06)
        assert depths.mean() == pytest.approx(depth, abs=0.05 * spread + 2.0 * spread**2 / depth)
        steps = 1.0 / depths / step
        assert np.abs(steps - np.round(steps)).max() < 1e-2


def test_scene_units_scale_it_and_nothing_stays_nothing():
    depth = jnp.array([0.0, 1.0, 2.0, 3.0])
    metres = nbv.DepthNoise.kinect_v1().apply(depth, KEY)
    scene = nbv.DepthNoise.kinect_v1(scale=5.0).apply(5.0 * depth, KEY)
    np.testing.assert_allclose(scene, 5.0 * metres, rtol=1e-5)
    assert metres[0] == 0.0


def test_a_noisy_scan_is_an_image_of_the_same_rays():
    ball, pose, camera = nbv.SDFSurface(nbv.sdf.Sphere(0.8)), nbv.look_at((0.0, 0.0, 2.5)), nbv.Camera()
    cloud = nbv.scan(ball, camera, pose)
    noisy = nbv.DepthNoise.kinect_v1(scale=2.5)(cloud, KEY, camera, pose)
    np.testing.assert_array_equal(noisy.missed, cloud.missed)
    both = np.asarray(noisy.mask)
    assert not np.any(both & ~np.asarray(cloud.mask))
    # All except the limb, where a pixel has no plane.
    assert both.sum() > 0.8 * int(cloud.count)
    outward = np.asarray(noisy.points)[both] / np.linalg.norm(np.asarray(noisy.points)[both], axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(np.sum(outward * np.asarray(noisy.normals)[both], axis=1), -1.0, 1.0)))
    assert np.median(angle) < 10.0
    exact = nbv.DepthNoise(0.0)(cloud, KEY, camera, pose)
    off = np.linalg.norm(np.asarray(exact.points)[np.asarray(exact.mask)], axis=1) - 0.8
    assert np.median(np.abs(off)) < 2e-3
