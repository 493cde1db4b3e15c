"""Surfaces from clouds, against the sphere that was scanned and against the posterior mean."""

import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import jaxnbv as nbv
from jaxnbv.scanning.screened_poisson import has_poisson
from jaxnbv.scanning.sdf import Sphere

RADIUS = 0.9
CENTRES = np.asarray(nbv.geometry.fibonacci_sphere(200, 1.0), np.float64)
MODEL = nbv.GeometricSPSR(lengthscale=0.05, truncation=10)


def mean_mesh(model, cloud, grid):
    return nbv.SurfaceSampler(model, grid, carving=None).mean_mesh(cloud)


def sphere_cloud(count=600, capacity=700):
    """Points all over a sphere about (0.2, 0, 0), in a cloud with spare rows."""
    normals = np.asarray(nbv.geometry.fibonacci_sphere(count, 1.0))
    return nbv.PointCloud.from_arrays(RADIUS * normals + [0.2, 0.0, 0.0], normals, capacity)


def check_sphere(mesh, tolerance):
    solid = mesh.to_trimesh()
    radii = np.linalg.norm(mesh.vertices - [0.2, 0.0, 0.0], axis=1)
    np.testing.assert_allclose(radii, RADIUS, atol=tolerance)
    assert solid.is_watertight
    # An outward winding makes the volume positive.
    assert solid.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=4 * tolerance)
    assert mesh.frame == nbv.Frame()


def test_the_mean_of_a_whole_scan_is_the_surface():
    check_sphere(mean_mesh(MODEL, sphere_cloud(), nbv.Grid(40)), 0.03)


def test_vertices_lie_where_the_posterior_mean_equals_its_level():
    """Also for half a sphere, where the model guesses the rest."""
    whole = sphere_cloud()
    half = nbv.PointCloud(whole.points, whole.normals, whole.mask & (whole.points[:, 1] > 0.0))
    posterior = MODEL.condition(half)
    mesh = mean_mesh(MODEL, half, nbv.Grid(60))
    mean = np.asarray(posterior.mean(mesh.vertices[::20].astype(np.float32)) - posterior.level)
    inside = float(posterior.mean(jnp.array([[0.2, 0.5, 0.0]]))[0] - posterior.level)
    assert inside < 0
    assert np.abs(mean).max() < 0.03 * abs(inside)
    # The scanned half is right, and the mesh continues where nothing was scanned.
    scanned_half = mesh.vertices[mesh.vertices[:, 1] > 0.1]
    assert np.abs(np.linalg.norm(scanned_half - [0.2, 0.0, 0.0], axis=1) - RADIUS).mean() < 0.03
    assert (mesh.vertices[:, 1] < -0.1).any()


class Balls(nbv.SurfaceModel):
    """A user's model with a mean in closed form: two balls for any cloud, one of them without data."""

    def condition(self, observations):
        return BallsPosterior()


class BallsPosterior(nbv.surfaces.SurfacePosterior):
    level: Float[Array, ""] = 0.25

    def __init__(self):
        self.level = jnp.asarray(0.25)

    def sample(self, key, num_samples):
        pytest.fail("the mesh of the mean needs no samples")

    def mean(self, x):
        away = jnp.linalg.norm(x - jnp.array([-0.6, 0.0, 0.0]), axis=-1) - 0.5
        return jnp.minimum(away, jnp.linalg.norm(x - jnp.array([0.6, 0.3, 0.0]), axis=-1) - 0.3) + 0.25


def test_a_users_model_is_meshed_without_pieces_that_hold_no_points():
    """The cloud's sphere cuts the left ball, and passes the other one."""
    with pytest.warns(UserWarning, match="left out 1 piece of the mesh with hardly any points"):
        mesh = mean_mesh(Balls(), sphere_cloud(), nbv.Grid(30))
    (part,) = mesh.to_trimesh().split()
    np.testing.assert_allclose(np.linalg.norm(part.vertices - [-0.6, 0.0, 0.0], axis=1), 0.5, atol=0.02)


@pytest.mark.parametrize(("points", "kept"), [(3, 1), (4, 2)])
def test_a_piece_stays_with_four_points_on_it(points, kept):
    """All points are on one ball, or a few on the other."""
    left = 0.5 * CENTRES + [-0.6, 0.0, 0.0]
    right = 0.3 * CENTRES[:: len(CENTRES) // points][:points] + [0.6, 0.3, 0.0]
    cloud = nbv.PointCloud.from_arrays(np.concatenate([left, right]), np.ones((len(left) + points, 3)) / np.sqrt(3))
    with warnings.catch_warnings(record=True) as warning_list:
        warnings.simplefilter("always")
        mesh = mean_mesh(Balls(), cloud, nbv.Grid(30))
    assert len(mesh.to_trimesh().split()) == kept
    assert len(warning_list) == 2 - kept


def test_empty_space_is_not_meshed():
    """One of the model's two balls is real. The camera sees past it through the other."""
    surface = nbv.SDFSurface(Sphere(0.5).translate((-0.6, 0.0, 0.0)))
    camera, pose = nbv.Camera(fov=1.3, height=60, width=60), nbv.look_at((0.0, 0.0, 2.5))

    def mesh(carving):
        sampler = nbv.SurfaceSampler(Balls(), nbv.Grid(30), num_samples=1, carving=carving)
        planner = nbv.Planner(nbv.Coverage(), nbv.FarthestView(8), camera, sampler, capacity=4000)
        return sampler.mean_mesh(planner.init(pose, nbv.scan(surface, camera, pose)))

    with pytest.warns(UserWarning, match="1 piece"):
        whole, plain = mesh(None), mean_mesh(Balls(), sphere_cloud(), nbv.Grid(30))
    np.testing.assert_array_equal(whole.vertices, plain.vertices)
    (ball,) = mesh(nbv.Carving()).to_trimesh().split()
    np.testing.assert_allclose(np.linalg.norm(ball.vertices - [-0.6, 0.0, 0.0], axis=1), 0.5, atol=0.03)


@pytest.mark.skipif(not has_poisson(), reason="pymeshlab, or the system's OpenGL library, is not installed")
def test_poisson_reconstruction_of_a_whole_scan_is_the_surface():
    cloud = sphere_cloud()
    mesh = nbv.scanning.screened_poisson(cloud, depth=6)
    check_sphere(mesh, 0.03)
    again = nbv.scanning.screened_poisson(cloud, depth=6)
    np.testing.assert_array_equal(mesh.vertices, again.vertices)
    assert len(nbv.scanning.screened_poisson(cloud, depth=3).faces) < 0.5 * len(mesh.faces)


def test_poisson_reconstruction_names_what_is_wrong(monkeypatch):
    cloud = sphere_cloud(20)
    with pytest.raises(nbv.InputError, match="depth is 0"):
        nbv.scanning.screened_poisson(cloud, depth=0)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pymeshlab", None)
        with pytest.raises(nbv.InputError, match=r'pip install "\.\[poisson\]"'):
            nbv.scanning.screened_poisson(cloud)
    if not has_poisson():
        pytest.skip("pymeshlab, or the system's OpenGL library, is not installed")
    few = jax.tree.map(lambda leaf: leaf[:3], cloud)
    together = nbv.PointCloud(jnp.zeros_like(cloud.points), cloud.normals, cloud.mask)
    broken = nbv.PointCloud(cloud.points.at[0, 0].set(jnp.nan), cloud.normals, cloud.mask)
    for wrong, message in ((few, "3 points, and"), (together, "no surface through 20"), (broken, "not finite")):
        with pytest.raises(nbv.InputError, match=message):
            nbv.scanning.screened_poisson(wrong)
