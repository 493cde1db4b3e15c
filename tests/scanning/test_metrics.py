"""Coverage against brute force and its bounds; points of known surfaces."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxnbv as nbv
from jaxnbv.scanning.metrics import coverage, truth_points
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.studies.scenes.demo import demo_object


def random_cloud(rng, count, capacity):
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return nbv.PointCloud.from_arrays(rng.uniform(-1, 1, (count, 3)), normals, capacity)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 30), radius=st.floats(0.01, 1.0))
def test_coverage_is_the_share_found_by_brute_force(seed, count, radius):
    rng = np.random.default_rng(seed)
    cloud, truth = random_cloud(rng, count, 40), rng.uniform(-1, 1, (50, 3))
    points = cloud.to_numpy()[0].astype(np.float64)
    nearest = np.linalg.norm(truth[:, None] - points[None], axis=-1).min(axis=1)
    share = coverage(cloud, truth, radius)
    assert share == np.mean(nearest <= radius)
    assert 0.0 <= share <= coverage(cloud, truth, 2 * radius) <= 1.0


def test_rows_that_are_not_filled_cover_nothing():
    # They hold zeros, so they would cover the origin.
    cloud = nbv.PointCloud.from_arrays([[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], capacity=4)
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert coverage(cloud, truth) == 0.5
    empty = nbv.PointCloud(cloud.points, cloud.normals, cloud.mask & False)
    assert coverage(empty, truth) == 0.0


@pytest.mark.parametrize(
    ("truth", "radius", "message"),
    [
        (np.zeros((0, 3)), 0.05, "no points"),
        (np.full((2, 3), np.nan), 0.05, "not finite"),
        (np.zeros((2, 3)), 0.0, "radius is 0.0"),
    ],
)
def test_bad_input_is_named(truth, radius, message):
    cloud = nbv.PointCloud.from_arrays([[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match=message):
        coverage(cloud, truth, radius)


def test_truth_of_a_solid_lies_on_its_surface():
    points = truth_points(nbv.SDFSurface(Sphere(0.8)), jax.random.key(0), 500)
    assert points.shape == (500, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.8, atol=2e-3)
    # Uniform by area: the height on a sphere is uniform, with a standard error of 0.8 / sqrt(3 * 500) = 0.021.
    assert abs(points[:, 1].mean()) < 4 * 0.021


def test_truth_of_a_mesh_is_sampled_by_area():
    # Two triangles in planes apart, of areas 1/2 and 2: 80 % of the points lie on the large one.
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 1], [0, 2, 1]]
    mesh = nbv.TriangleMesh.from_arrays(np.array(vertices, float), np.array([[0, 1, 2], [3, 4, 5]]))
    points = truth_points(mesh, jax.random.key(1), 2000)
    share = np.mean(points[:, 2] > 0)
    assert abs(share - 0.8) < 4 * np.sqrt(0.8 * 0.2 / 2000)


def test_other_surfaces_have_no_truth():
    grid = nbv.Grid(8)
    distance = np.linalg.norm(np.stack(np.meshgrid(*[grid.axis] * 3, indexing="ij")), axis=0) - 1.0
    assert truth_points(nbv.GridSurface.from_values(distance, 0.0, grid), jax.random.key(0)) is None
    assert len(truth_points(demo_object(), jax.random.key(0), 10)) == 10
