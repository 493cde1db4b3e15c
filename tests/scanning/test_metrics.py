"""Coverage of a ball against areas of caps; distances of surfaces against brute force and closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist, directed_hausdorff

import jaxnbv as nbv
from jaxnbv.scanning.metrics import SURFACE_POINTS, coverage, surface_distance, truth_points
from jaxnbv.scanning.sdf import Sphere

RADIUS, AWAY = 0.8, 2.5
BALL = nbv.SDFSurface(Sphere(RADIUS))
# Uniform by area. Their share in any part of the ball has a standard error of at most 0.0035.
POINTS = RADIUS * np.asarray(nbv.geometry.fibonacci_sphere(20_000), np.float64)
SIDES = nbv.look_at(AWAY * jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))


def views_of(camera, poses=SIDES, deviation=0.0):
    noise = nbv.SensorNoise(deviation, deviation)
    clouds = [noise(nbv.scan(BALL, camera, pose), jax.random.key(i)) for i, pose in enumerate(poses)]
    return [nbv.View(pose, scan, scan, None, camera) for scan, pose in zip(clouds, poses, strict=True)]


@pytest.mark.parametrize("pixels", [40, 200])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_coverage_of_a_ball_is_the_area_of_its_caps(pixels, noise):
    """From a distance d a ball of radius r shows the share (1 - r / d) / 2 of its area. Two opposite views show twice
    that. A view from the side adds half of the rest, except for two opposite parts of the belt."""
    camera = nbv.Camera(height=pixels, width=pixels, fov=0.75)
    shares = coverage(views_of(camera, deviation=noise), POINTS)
    limit = RADIUS / AWAY
    visible = [POINTS @ np.asarray(pose.position, np.float64) / AWAY >= RADIUS * limit for pose in SIDES]
    expected = [np.mean(np.any(visible[: count + 1], axis=0)) for count in range(3)]
    assert expected[:2] == pytest.approx([(1 - limit) / 2, 1 - limit], abs=0.01)
    # A pixel at the limb shows a little more or less than the ball's own limb.
    np.testing.assert_allclose(shares, expected, atol=0.03)
    assert shares == sorted(shares)


def test_a_view_past_the_object_and_points_elsewhere_are_not_covered():
    camera = nbv.Camera(height=20, width=20)
    away = nbv.look_at((0.0, 0.0, AWAY), target=(0.0, 0.0, 2 * AWAY))
    assert coverage(views_of(camera, away[None]), POINTS) == [0.0]
    inner, outer = (scale * POINTS[POINTS[:, 2] > 0.9 * RADIUS] for scale in (0.9, 1.1))
    one = views_of(camera, SIDES[:1])
    assert coverage(one, inner) == coverage(one, outer) == [0.0]
    assert coverage(one, inner, size=0.1) == [1.0]


@pytest.mark.parametrize(
    ("truth", "size", "message"),
    [
        (np.zeros((0, 3)), 0.05, "no points"),
        (np.full((2, 3), np.nan), 0.05, "not finite"),
        (np.zeros((2, 3)), 0.0, "size is 0.0"),
    ],
)
def test_bad_input_is_named(truth, size, message):
    with pytest.raises(ValueError, match=message):
        coverage(views_of(nbv.Camera(height=4, width=4)), truth, size)


def test_a_scan_of_another_camera_is_named():
    view = views_of(nbv.Camera(height=4, width=4))[0]
    with pytest.raises(ValueError, match="5 x 5"):
        coverage([dataclasses.replace(view, camera=nbv.Camera(height=5, width=5))], POINTS)


def test_truth_of_a_solid_lies_on_its_surface():
    points = truth_points(nbv.SDFSurface(Sphere(0.8)), jax.random.key(0), 500)
    assert points.shape == (500, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.8, atol=2e-3)
    # Uniform by area: the height on a sphere is uniform, with a standard error of 0.8 / sqrt(3 * 500) = 0.021.
    assert abs(points[:, 1].mean()) < 4 * 0.021


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 40), m=st.integers(1, 40))
def test_distances_are_those_found_by_brute_force(seed, n, m):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))
    distance, between = surface_distance(first, second), cdist(first, second)
    assert distance.accuracy == pytest.approx(between.min(axis=1).mean())
    assert distance.completeness == pytest.approx(between.min(axis=0).mean())
    assert distance.chamfer == pytest.approx(distance.accuracy + distance.completeness)
    both = directed_hausdorff(first, second)[0], directed_hausdorff(second, first)[0]
    assert distance.hausdorff == pytest.approx(max(both))


def test_two_samples_of_one_surface_are_as_far_apart_as_documented():
    sphere = trimesh.creation.icosphere(4, 0.8)
    mesh = nbv.TriangleMesh(sphere.vertices, sphere.faces, nbv.Frame())
    distance = surface_distance(*(mesh.sample_points(jax.random.key(seed), SURFACE_POINTS) for seed in (0, 1)))
    assert distance.chamfer == pytest.approx(np.sqrt(sphere.area / SURFACE_POINTS), rel=0.03)
    assert distance.hausdorff < 0.06
