"""The demonstration object: its size, its parts, and what can be seen of it."""

import numpy as np
import pytest

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.mesh import mesh_from_sdf
from jaxnbv.scanning.scanner import scan
from jaxnbv.studies.scenes.demo import demo_object


@pytest.fixture(scope="module")
def mesh():
    return mesh_from_sdf(demo_object().sdf, Grid(120, 1.4))


def test_it_fills_the_scene(mesh):
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(2.5, abs=0.01)
    assert np.abs([low, high]).max() <= 1.25 + 1e-3
    np.testing.assert_allclose(low + high, 0.0, atol=0.06)


def test_it_is_a_closed_solid_in_one_piece(mesh):
    solid = mesh.to_trimesh()
    assert solid.is_watertight
    assert solid.body_count == 1
    assert solid.volume > 0


@pytest.mark.slow
def test_its_inside_shows_from_few_views():
    """The mug's floor is seen from above only."""
    camera = Camera(height=25, width=25)
    rays = camera.height * camera.width
    cloud = scan(demo_object(), camera, look_at(fibonacci_sphere(60, 2.5)))
    points, mask = np.asarray(cloud.points), np.asarray(cloud.mask)
    assert (mask.sum(axis=1) > 0.04 * rays).all()
    floor = mask & (np.hypot(points[..., 0], points[..., 2]) < 0.35) & (np.abs(points[..., 1] + 0.6) < 0.15)
    views = (floor.sum(axis=1) > 0.004 * rays).mean()
    assert 0.02 < views < 0.35
