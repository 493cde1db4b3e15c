"""The coverage acquisition against brute force in float64."""

import jax
import numpy as np
import pytest
from on_grid import balls
from opinions import drawn_cloud, nothing

from jaxnbv.acquisition import expected_value
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.scanning import Grid, scan
from jaxnbv.tasks import Coverage

CAMERA, GRID = Camera(height=8, width=8), Grid(20)


def chamfer(points, data):
    squared = ((points[:, None].astype(np.float64) - data[None].astype(np.float64)) ** 2).sum(-1)
    return squared.min(axis=1).sum() if len(points) else 0.0


def test_a_scan_that_sees_nothing_or_nothing_new_is_worth_nothing():
    data = drawn_cloud(np.random.default_rng(1), 20, 32)
    score = Coverage()
    assert float(score(score.context(data), nothing(9))) == 0
    assert float(score(score.context(data), data)) == pytest.approx(0.0, abs=1e-5)


def test_the_acquisition_against_brute_force_over_all_scans():
    rng = np.random.default_rng(2)
    surfaces = balls(GRID, (0.8, 0.6, 0.9), rng.uniform(-0.3, 0.3, (3, 3)))
    data, poses = drawn_cloud(rng, 60, 64), look_at(fibonacci_sphere(5, 2.5))
    expected = np.zeros((3, 5))
    for s, p in np.ndindex(3, 5):
        surface = jax.tree.map(lambda leaf, s=s: leaf[s], surfaces)
        expected[s, p] = chamfer(scan(surface, CAMERA, poses[p]).to_numpy()[0], data.to_numpy()[0])
    assert expected.min() > 0
    found = expected_value(Coverage(), data, surfaces, CAMERA, poses)
    np.testing.assert_allclose(found, expected.mean(axis=0), rtol=1e-4)


def test_gradient_in_the_scan(x64):
    """d/dx min_y |x - y|^2 = 2 (x - y*); masked rows and normals have none."""
    rng = np.random.default_rng(3)
    data, seen = drawn_cloud(rng, 15, 20), drawn_cloud(rng, 6, 9)
    score = Coverage()
    gradient = jax.grad(lambda points: score(data, PointCloud(points, seen.normals, seen.mask)))(seen.points)
    points, known = np.asarray(seen.points)[:6], np.asarray(data.points)[:15]
    nearest = known[((points[:, None] - known[None]) ** 2).sum(-1).argmin(axis=1)]
    np.testing.assert_allclose(gradient[:6], 2 * (points - nearest), atol=1e-12)
    assert not np.asarray(gradient)[6:].any()
