"""Surface that no ray has met is shown as uncertain, whatever the posterior's deviation."""

import jax
import numpy as np
from scipy.spatial import ConvexHull

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Capsule
from jaxnbv.viz import report_data
from jaxnbv.viz.mean_surface import MeanSurface, near_points


def test_the_deviation_allows_for_a_quarter_of_the_distance_to_the_nearest_point():
    """A unit sphere with one measured point, whose posterior deviation is 0.03 everywhere."""
    vertices = np.asarray(nbv.geometry.fibonacci_sphere(200), np.float64)
    surface = MeanSurface(vertices, ConvexHull(vertices).simplices, vertices, np.full(200, 0.03))
    # Empty rows are at the origin, and must not count as points.
    cloud = nbv.PointCloud.from_arrays(vertices[:1], vertices[:1], capacity=4)
    result = near_points(surface, cloud)
    chord = 2 * np.sin(0.5 * np.arccos(np.clip(vertices @ vertices[0], -1, 1)))
    np.testing.assert_allclose(result.deviation, np.sqrt(0.03**2 + (chord / 4) ** 2), rtol=1e-5)
    np.testing.assert_array_equal(result.vertices, vertices)
    assert near_points(None, cloud) is None


def test_pieces_that_hold_no_points_are_not_shown():
    """Two unit spheres, with one measured point on the first."""
    ball = np.asarray(nbv.geometry.fibonacci_sphere(200), np.float64)
    faces = ConvexHull(ball).simplices
    other = ball + np.array([3.0, 0.0, 0.0])
    both = np.concatenate([ball, other])
    surface = MeanSurface(both, np.concatenate([faces, faces + 200]), np.concatenate([ball, ball]), np.full(400, 0.03))
    cloud = nbv.PointCloud.from_arrays(ball[:1], ball[:1])
    result = near_points(surface, cloud)
    np.testing.assert_array_equal(result.vertices, ball)
    np.testing.assert_array_equal(result.faces, faces)
    assert near_points(surface, nbv.PointCloud.from_arrays([[1.5, 9.0, 0.0]], [[0.0, 1.0, 0.0]])) is None


def test_an_end_beyond_the_images_border_is_never_shown_as_certain():
    scene = nbv.SDFSurface(Capsule([-0.8, 0.0, 0.0], [0.8, 0.0, 0.0], 0.3))
    model = nbv.ScreenedSPSR(nbv.GeometricSPSR((0.02, 0.06), (0.2, 0.25), truncation=16))
    camera = nbv.Camera(height=24, width=24)
    planner = nbv.Planner(
        nbv.Coverage(),
        nbv.RandomView(30),
        camera,
        nbv.SurfaceSampler(model, grid=nbv.Grid(40), num_samples=2),
        capacity=1024,
    )
    first = nbv.look_at((-0.6, 0.0, 1.8), (-0.6, 0.0, 0.0))
    (view,) = report_data(
        nbv.simulate(planner, scene, first, 1, jax.random.key(0), progress=False), progress=False
    ).views
    surface = view.surface
    local = (surface.vertices - np.asarray(first.position)) @ np.asarray(first.rotation)
    column, row = camera.to_pixels(local[:, :2] / local[:, 2:]).T
    beside = np.max([-column, column - camera.width, -row, row - camera.height], axis=0)
    outside = beside > 0.3 * camera.width
    met = np.linalg.norm(surface.vertices[:, None] - view.new[None], axis=-1).min(axis=1) < 0.05
    assert outside.sum() > 20
    assert met.sum() > 20
    assert surface.deviation[outside].min() > 2 * np.percentile(surface.deviation[met], 90)
