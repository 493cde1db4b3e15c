"""Normals of plain points against those of the surface that they were drawn from."""

import numpy as np

import jaxnbv as nbv

CENTRES = np.asarray(nbv.fibonacci_sphere(3000), np.float64)


def angles(found, expected):
    return np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=1), -1.0, 1.0)))


def test_normals_of_a_ball_are_its_radii_and_face_each_points_own_sensor():
    """Within a patch of 16 of 3,000 points, 0.073 in radius, a ball turns by four degrees."""
    found = nbv.estimate_normals(0.7 * CENTRES, 3.0 * CENTRES)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-9)
    assert np.percentile(angles(found, CENTRES), 99) < 2.0
    inward = nbv.estimate_normals(0.7 * CENTRES, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(inward, -found, atol=1e-9)


def test_more_neighbours_smooth_noise():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, (4000, 2)), 0.02 * rng.normal(size=(4000, 1))], axis=1)
    up = np.array([[0.0, 0.0, 1.0]])
    few, many = (np.median(angles(nbv.estimate_normals(points, (0, 0, 5.0), k), up)) for k in (8, 64))
    assert many < 0.3 * few
    assert many < 3.0
