"""The scanner: rows, batches of poses, sensor noise, and the round trip through a depth image."""

import jax
import numpy as np
import pytest
import trimesh

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.scanning.mesh import TriangleMesh
from jaxnbv.scanning.scanner import SensorNoise, scan
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.scanning.sphere_tracing import SDFSurface

ICOSPHERE = trimesh.creation.icosphere(4)
SURFACES = {
    "sdf": SDFSurface(Sphere(0.6).translate([0.2, 0.1, 0.0])),
    "mesh": TriangleMesh.from_arrays(ICOSPHERE.vertices, ICOSPHERE.faces),
}


@pytest.mark.parametrize("name", SURFACES)
def test_batched_poses_equal_single_ones(name):
    camera, poses = Camera(height=12, width=17), look_at(fibonacci_sphere(6, 2.5))
    batch = scan(SURFACES[name], camera, poses)
    assert batch.points.shape == (6, 12 * 17, 3)
    for i in range(6):
        alone = scan(SURFACES[name], camera, poses[i])
        assert bool((alone.mask == batch.mask[i]).all())
        np.testing.assert_allclose(alone.points, batch.points[i], atol=1e-5)
        np.testing.assert_allclose(alone.normals, batch.normals[i], atol=1e-4)


def test_rows_are_pixels_row_by_row_and_misses_are_masked():
    """A small sphere low and right in the image fills exactly the pixels whose rays pass within its radius."""
    camera, pose = Camera(height=20, width=30, fov=0.6), look_at([0.0, 0.0, 2.5])
    centre, radius = np.array([0.4, -0.3, 0.2]), 0.2
    cloud = scan(SDFSurface(Sphere(radius).translate(centre)), camera, pose)
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
    clean = PointCloud.from_arrays(np.tile([0.3, -0.2, 0.5], (n, 1)), normals, capacity=n + 10)
    noisy = SensorNoise(points=0.02, normals=0.05)(clean, jax.random.key(0))
    points, turned = noisy.to_numpy()
    error = points - [0.3, -0.2, 0.5]
    # Five standard errors: sigma / sqrt(n) of a mean, sigma / sqrt(2 n) of a standard deviation.
    assert (np.abs(error.mean(axis=0)) < 5 * 0.02 / np.sqrt(n)).all()
    assert (np.abs(error.std(axis=0) - 0.02) < 5 * 0.02 / np.sqrt(2 * n)).all()
    assert (np.abs(np.corrcoef(error.T) - np.eye(3)) < 5 / np.sqrt(n)).all()
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0, atol=1e-5)
    # A point's error tells nothing of its normal's.
    together = np.corrcoef(error.T, (turned - normals).T)[:3, 3:]
    assert (np.abs(together) < 5 / np.sqrt(n)).all()
    # Across the normal, n + eps over its length keeps the deviation but for a factor 1 - O(sigma^2).
    across = turned @ np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6]]).T
    assert (np.abs(across.std(axis=0) / 0.05 - 1) < 5 / np.sqrt(2 * n) + 2 * 0.05**2).all()
    assert not np.asarray(noisy.points)[n:].any()
    assert not np.asarray(noisy.normals)[n:].any()
    np.testing.assert_array_equal(noisy.mask, clean.mask)


def test_normals_of_a_batch_of_noisy_scans_are_unit():
    scans = scan(SURFACES["sdf"], Camera(height=6, width=6), look_at([[0.0, 0.0, 2.5], [2.5, 0.0, 0.0]]))
    noisy = SensorNoise()(scans, jax.random.key(0))
    np.testing.assert_allclose(np.linalg.norm(noisy.normals, axis=-1), np.asarray(scans.mask), atol=1e-5)
