"""The demonstration object: its size, parts and visible features."""

import numpy as np
import pytest

from jaxnbv.scanning.grid import Grid
from jaxnbv.scanning.mesh import mesh_from_sdf
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
