"""The surface of the posterior mean, its deviation, and its pieces near points."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from small_run import SphereModel, small_planner, small_run

import jaxnbv as nbv
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning.sdf import Capsule
from jaxnbv.viz.mean_surface import MeanSurface, mean_surface, near_points
from jaxnbv.viz.shown_surface import shown_surface

POINT = nbv.PointCloud.from_arrays([[0.9, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
BALL = np.asarray(nbv.geometry.fibonacci_sphere(200), np.float64)
FACES = ConvexHull(BALL).simplices


def surface_of(sampler, observations):
    return mean_surface(sampler, StepInputs(observations, sampler.posterior(observations)))


@pytest.fixture(scope="module")
def spheres():
    """A planner whose surfaces are spheres, and its observations."""
    planner = small_planner(nbv.RandomView(), model=SphereModel(), grid=nbv.Grid(28), num_samples=64)
    return planner.sampler, planner.init(None, POINT)


def test_any_posterior_has_a_surface_with_a_standard_deviation(spheres):
    # f = |x| - r with r ~ N(0.9, 0.03^2). The surface is a sphere, known to 0.03 everywhere, as estimated from 64
    # samples.
    surface = surface_of(*spheres)
    radius = np.linalg.norm(surface.vertices, axis=1)
    np.testing.assert_allclose(radius, 0.9, atol=4 * 0.03 / 8 + 0.005)
    np.testing.assert_allclose(surface.deviation, 0.03, rtol=4 / np.sqrt(2 * 64))
    np.testing.assert_allclose(np.sum(surface.normals * surface.vertices, axis=1) / radius, 1.0, atol=1e-2)
    sampler, observations = spheres
    assert surface_of(dataclasses.replace(sampler, grid=nbv.Grid(28, 0.2), carving=None), observations) is None


def test_the_surface_of_the_mean_is_carved(spheres):
    sampler, observations = spheres
    empty = jnp.broadcast_to((sampler.grid.axis > 0.3)[:, None, None], observations.empty_nodes.shape)
    vertices = surface_of(sampler, eqx.tree_at(lambda s: s.empty_nodes, observations, empty)).vertices
    assert vertices[:, 0].max() < 0.3 + sampler.grid.spacing
    # The other side is unchanged.
    left = vertices[vertices[:, 0] < 0.3 - sampler.grid.spacing]
    np.testing.assert_allclose(np.linalg.norm(left, axis=1).max(), 0.9, atol=0.02)


def test_the_deviation_allows_for_a_quarter_of_the_distance_to_the_nearest_point():
    """A unit sphere with one measured point, whose posterior deviation is 0.03 everywhere."""
    surface = MeanSurface(BALL, FACES, BALL, np.full(200, 0.03))
    # Empty rows are at the origin, and must not count as points.
    cloud = nbv.PointCloud.from_arrays(BALL[:1], BALL[:1], capacity=4)
    result = near_points(surface, cloud)
    chord = 2 * np.sin(0.5 * np.arccos(np.clip(BALL @ BALL[0], -1, 1)))
    np.testing.assert_allclose(result.deviation, np.sqrt(0.03**2 + (chord / 4) ** 2), rtol=1e-5)
    np.testing.assert_array_equal(result.vertices, BALL)
    assert near_points(None, cloud) is None


def test_pieces_that_hold_no_points_are_not_shown():
    """Two unit spheres, with one measured point on the first."""
    both = np.concatenate([BALL, BALL + np.array([3.0, 0.0, 0.0])])
    surface = MeanSurface(both, np.concatenate([FACES, FACES + 200]), np.concatenate([BALL, BALL]), np.full(400, 0.03))
    result = near_points(surface, nbv.PointCloud.from_arrays(BALL[:1], BALL[:1]))
    np.testing.assert_array_equal(result.vertices, BALL)
    np.testing.assert_array_equal(result.faces, FACES)
    assert near_points(surface, nbv.PointCloud.from_arrays([[1.5, 9.0, 0.0]], [[0.0, 1.0, 0.0]])) is None


def test_surface_that_was_not_seen_is_known_less_and_never_shown_as_certain():
    """A capsule whose right end is beyond the image's border."""
    scene = nbv.SDFSurface(Capsule([-0.8, 0.0, 0.0], [0.8, 0.0, 0.0], 0.3))
    first = nbv.look_at((-0.6, 0.0, 1.8), (-0.6, 0.0, 0.0))
    model = nbv.ScreenedSPSR(nbv.GeometricSPSR((0.02, 0.06), (0.2, 0.25), truncation=8))
    episode = small_run(nbv.RandomView(8), 1, scene, first=first, model=model, grid=nbv.Grid(32))
    sampler, observations, points = episode.planner.sampler, episode.observations_after(1), episode.cloud.to_numpy()[0]
    inputs = StepInputs(observations, sampler.posterior(observations))
    mean, surface, camera = mean_surface(sampler, inputs), shown_surface(sampler, inputs), episode.planner.camera
    distances = np.linalg.norm(mean.vertices[:, None] - points[None], axis=-1).min(axis=1)
    assert np.median(mean.deviation[distances < 0.1]) < 0.3 * np.median(mean.deviation[distances > 0.6])
    local = (surface.vertices - np.asarray(first.position)) @ np.asarray(first.rotation)
    column, row = camera.to_pixels(local[:, :2] / local[:, 2:]).T
    beside = np.max([-column, column - camera.width, -row, row - camera.height], axis=0)
    outside = beside > 0.3 * camera.width
    far = np.linalg.norm(surface.vertices[:, None] - points[None], axis=-1).min(axis=1)
    met = far < 0.05
    assert min(outside.sum(), met.sum()) > 20
    assert surface.deviation[outside].min() > 2 * np.percentile(surface.deviation[met], 90)
    assert (surface.deviation > 0.249 * far).all()
