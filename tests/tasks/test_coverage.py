"""Coverage and expected new area against integrals over known surfaces and brute force in float64."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import balls
from opinions import context_of, drawn_cloud, score_of
from scipy.integrate import quad

import jaxnbv as nbv
from jaxnbv.acquisition import ImaginedView
from jaxnbv.geometry.cloud import limit_capacity
from jaxnbv.geometry.neighbours import NearestPoints
from jaxnbv.scanning import pixel_area
from jaxnbv.scanning.sdf import Cuboid, Sphere

SMALL, POSE = nbv.Camera(height=8, width=8), nbv.look_at((0.4, 1.1, 2.2))
RADIUS, AWAY = 0.5, math.dist((0, 0, 0), (0.4, 1.1, 2.2))


def looked_at(height=24, width=24):
    """A ball in a camera with this number of pixels."""
    camera = nbv.Camera(height=height, width=width, aspect=height / width)
    return nbv.scan(nbv.SDFSurface(Sphere(RADIUS)), camera, POSE), camera


def ball_area(sharpest: float) -> float:
    """Area of the visible part of the ball. A pixel at a cosine of incidence below the sharpest counts as cos /
    sharpest of its area."""

    def strip(angle):
        distance = math.sqrt(AWAY**2 + RADIUS**2 - 2 * AWAY * RADIUS * math.cos(angle))
        cosine = (AWAY * math.cos(angle) - RADIUS) / distance
        return 2 * math.pi * RADIUS**2 * math.sin(angle) * min(1.0, cosine / sharpest)

    return quad(strip, 0.0, math.acos(RADIUS / AWAY), limit=200)[0]


def test_the_area_of_a_ball_is_its_integral():
    cloud, camera = looked_at(120, 240)
    for steepest in (0.2, 0.5):
        area = float(jnp.sum(pixel_area(cloud, camera, POSE, steepest)))
        # A pixel at the limb is a hit or a miss, which is about one in a hundred of the area.
        assert area == pytest.approx(ball_area(steepest), rel=0.02)


def test_the_area_of_a_slanted_face_does_not_depend_on_the_rays_or_the_distance():
    face = nbv.SDFSurface(Cuboid((0.5, 0.4, 1e-3)))
    for fov, away in ((1.4, 1.0), (1.0, 1.6)):
        camera, pose = nbv.Camera(height=200, width=200, fov=fov), nbv.look_at((away, 0.3 * away, 1.5 * away))
        area = float(jnp.sum(pixel_area(nbv.scan(face, camera, pose), camera, pose, 0.2)))
        # The border is accurate to a pixel: a share of 2 / 120 * (1 / 1.0 + 1 / 0.8) of the face, most of it by chance.
        assert area == pytest.approx(1.0 * 0.8, rel=0.03)


def cloud_of(points, capacity=None):
    points = np.asarray(points, float)
    return nbv.PointCloud.from_arrays(points, points / np.linalg.norm(points, axis=1, keepdims=True), capacity)


@eqx.filter_jit
def score_of_view(acquisition, known, view):
    return acquisition.score(context_of(acquisition, known), view)


def test_the_score_is_the_area_weighted_by_the_distance_to_d():
    ball, camera = looked_at()
    rng = np.random.default_rng(0)
    data = rng.normal(size=(40, 3)) + np.array([0.0, 4.0, 0.0])
    data *= RADIUS / np.linalg.norm(data, axis=1, keepdims=True)
    acquisition, cloud = nbv.NewSurface(0.15), cloud_of(data, 64)
    score = float(score_of_view(acquisition, cloud, ImaginedView(ball, camera, POSE)))

    points, mask = np.asarray(ball.points, np.float64), np.asarray(ball.mask)
    distance = np.linalg.norm(points[:, None] - data[None], axis=-1).min(axis=1)
    # A pixel steeper than 60 degrees counts less.
    area = np.asarray(pixel_area(ball, camera, POSE, 0.5), np.float64)
    expected = float(np.sum(area[mask] * np.clip(distance[mask] / 0.15 - 1.0, 0.0, 1.0)))
    assert 0.1 * area.sum() < expected < 0.9 * area.sum()
    # Between nodes a distance has a small error relative to their spacing, here 0.026, of either sign.
    assert score == pytest.approx(expected, rel=0.03)


def test_between_the_points_of_a_sparse_cloud_nothing_is_new():
    """Points 0.1 apart all over the visible ball. By the size alone half of the ball would be new."""
    ball, camera = looked_at()
    cloud = cloud_of(RADIUS * np.asarray(nbv.geometry.fibonacci_sphere(300)))
    score = float(score_of_view(nbv.NewSurface(0.02), cloud, ImaginedView(ball, camera, POSE)))
    assert score < 0.02 * float(jnp.sum(pixel_area(ball, camera, POSE, 0.2)))


def observed(points, capacity):
    """Observations after one view of some points, few of which are kept."""
    # The pixels are so small that hits are points.
    camera, pose = nbv.Camera(fov=0.1, height=80, width=80), nbv.look_at((0.0, 0.0, 2.5))
    own = cloud_of(points, camera.num_rays)
    scan = nbv.PointCloud(own.points, own.normals, own.mask, jnp.zeros(6400, bool), jnp.zeros(6400))
    start = nbv.Observations.start(limit_capacity(own, capacity), 2, nbv.Grid(40, 1.2))
    return start.add_view(pose, scan, camera, nbv.Carving(), None)


def test_new_area_does_not_depend_on_the_kept_points():
    """Hits all over the visible ball except for a hole. The area of the hole is new, although D is too sparse to
    tell."""
    cloud, camera = looked_at(120, 120)
    view = ImaginedView(cloud, camera, POSE)
    everywhere = np.asarray(nbv.geometry.fibonacci_sphere(6000), np.float64)
    toward = np.asarray(POSE.position, np.float64) / AWAY
    radius = 0.4
    hits = RADIUS * everywhere[everywhere @ toward < math.cos(radius)]
    observations = observed(hits, 60)
    new, by_d = (float(score_of_view(nbv.NewSurface(), one, view)) for one in (observations, observations.cloud))
    # Surface between one and two spacings of the grid (0.062) from a hit counts in part, on average one half.
    whole, rim = (2 * math.pi * RADIUS**2 * (1 - math.cos(radius - margin / RADIUS)) for margin in (0.062, 0.123))
    assert rim < new < whole
    assert by_d < 0.1 * new


def test_between_the_rays_of_a_coarse_sensor_nothing_is_new():
    """A ball seen by 14 x 14 pixels, and again from there by nine times as many on a side. Hits alone are almost two
    spacings of the grid apart, which would leave a twelfth of the area new."""
    cloud, camera = looked_at(14, 14)
    start = nbv.Observations.start(limit_capacity(cloud, 60), 2, nbv.Grid(40, 1.2))
    observations = start.add_view(POSE, cloud, camera, nbv.Carving(), None)
    view = ImaginedView(*looked_at(120, 120), POSE)
    points = dataclasses.replace(start, looks=start.looks.with_points(cloud))
    new, by_points = (float(score_of_view(nbv.NewSurface(), one, view)) for one in (observations, points))
    assert new < 0.03 * ball_area(0.5)
    assert by_points > 0.08 * ball_area(0.5)


@pytest.mark.slow
def test_its_derivative_is_the_central_difference(x64):
    """For a small step the derivative in the pose is the central difference of its smooth part."""
    surfaces, camera = balls(nbv.Grid(32), [0.7]), nbv.Camera(height=16, width=16)
    cloud = cloud_of([[0.0, 0.0, 0.7]])

    def value(x):
        pose = nbv.look_at(jnp.array([x, 0.4, 2.4]))
        return nbv.expected_value(nbv.NewSurface(0.3), cloud, surfaces, camera, pose[None])[0]

    slope = float(jax.grad(value)(0.5))
    step = 1e-6
    differences = (value(0.5 + step) - value(0.5 - step)) / (2 * step)
    assert abs(slope) > 1e-3
    assert slope == pytest.approx(float(differences), rel=1e-3)


@pytest.mark.parametrize("score", [nbv.Coverage(), nbv.NewSurface()])
def test_a_scan_that_sees_nothing_or_nothing_new_is_worth_nothing(score):
    ball, camera = looked_at()
    far, empty = cloud_of([[1.0, 1.0, 1.0]], ball.capacity), jax.tree.map(jnp.zeros_like, ball)
    assert float(score_of_view(score, ball, ImaginedView(ball, camera, POSE))) == pytest.approx(0.0, abs=1e-5)
    assert float(score_of_view(score, far, ImaginedView(empty, camera, POSE))) == 0.0
    assert float(score_of_view(score, far, ImaginedView(ball, camera, POSE))) > 0.1


def chamfer(points, data):
    squared = ((points[:, None].astype(np.float64) - data[None].astype(np.float64)) ** 2).sum(-1)
    return squared.min(axis=1).sum() if len(points) else 0.0


def test_the_acquisition_against_brute_force_over_all_scans():
    rng = np.random.default_rng(2)
    surfaces = balls(nbv.Grid(20), (0.8, 0.6), rng.uniform(-0.3, 0.3, (2, 3)))
    data, poses = drawn_cloud(rng, 60, 64), nbv.look_at(nbv.geometry.fibonacci_sphere(3, 2.5))
    expected = np.zeros((2, 3))
    for s, p in np.ndindex(2, 3):
        surface = jax.tree.map(lambda leaf, s=s: leaf[s], surfaces)
        expected[s, p] = chamfer(nbv.scan(surface, SMALL, poses[p]).to_numpy()[0], data.to_numpy()[0])
    assert expected.min() > 0
    values = nbv.expected_value(nbv.Coverage(), data, surfaces, SMALL, poses)
    np.testing.assert_allclose(values, expected.mean(axis=0), rtol=1e-4)


def test_coverage_and_its_gradient_in_the_scan_against_brute_force(x64):
    """d/dx min_y |x - y|^2 = 2 (x - y*). Masked rows and normals have zero derivatives."""
    rng = np.random.default_rng(3)
    data, scan = drawn_cloud(rng, 15, 20), drawn_cloud(rng, 6, 9)
    of_points = lambda points: score_of(  # noqa: E731
        nbv.Coverage(), NearestPoints.of(data), nbv.PointCloud(points, scan.normals, scan.mask)
    )
    value, gradient = jax.value_and_grad(of_points)(scan.points)
    points, cloud_points = np.asarray(scan.points)[:6], np.asarray(data.points)[:15]
    squared = ((points[:, None] - cloud_points[None]) ** 2).sum(-1)
    assert float(value) == pytest.approx(squared.min(axis=1).sum(), rel=1e-12)
    np.testing.assert_allclose(gradient[:6], 2 * (points - cloud_points[squared.argmin(axis=1)]), atol=1e-12)
    assert not np.asarray(gradient)[6:].any()
