"""Chamfer and Hausdorff distance against brute force and closed forms."""

import jax
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist, directed_hausdorff

from jaxnbv.checks import InputError
from jaxnbv.geometry.frame import Frame
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import SURFACE_POINTS, surface_distance


def points_of(mesh, seed, count=SURFACE_POINTS):
    return TriangleMesh(mesh.vertices, mesh.faces, Frame()).sample_points(jax.random.key(seed), count)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 40), m=st.integers(1, 40))
def test_distances_are_those_found_by_brute_force(seed, n, m):
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))
    found, between = surface_distance(first, second), cdist(first, second)
    assert found.accuracy == pytest.approx(between.min(axis=1).mean())
    assert found.completeness == pytest.approx(between.min(axis=0).mean())
    assert found.chamfer == pytest.approx(found.accuracy + found.completeness)
    both = directed_hausdorff(first, second)[0], directed_hausdorff(second, first)[0]
    assert found.hausdorff == pytest.approx(max(both))


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31))
def test_symmetry_zero_scale_and_the_triangle_inequality(seed):
    rng = np.random.default_rng(seed)
    a, b, c = (rng.normal(size=(count, 3)) for count in (12, 17, 9))
    there, back = surface_distance(a, b), surface_distance(b, a)
    assert (there.chamfer, there.hausdorff) == (pytest.approx(back.chamfer), back.hausdorff)
    assert (there.accuracy, there.completeness) == (back.completeness, back.accuracy)
    assert surface_distance(a, a[::-1]) == (0.0, 0.0, 0.0)
    assert surface_distance(3.0 * a, 3.0 * b).chamfer == pytest.approx(3.0 * there.chamfer)
    assert there.hausdorff <= surface_distance(a, c).hausdorff + surface_distance(c, b).hausdorff + 1e-12
    assert 0.5 * there.chamfer <= there.hausdorff


def test_concentric_spheres_are_their_radii_apart():
    inner, outer = (trimesh.creation.icosphere(5, radius) for radius in (0.6, 0.9))
    found = surface_distance(points_of(inner, 0), points_of(outer, 1))
    for value in (found.accuracy, found.completeness):
        # Nearest samples lie beside the foot of the perpendicular, a little farther.
        assert 0.299 < value < 0.302
    assert 0.3 < found.hausdorff < 0.32


def test_a_square_shifted_in_its_plane_lacks_a_strip():
    """Of the unit square a strip of width s sticks out on one side, where the mean distance is s / 2."""
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    shifted = square.copy().apply_translation([0.4, 0.0, 0.0])
    found = surface_distance(points_of(square, 0), points_of(shifted, 1))
    floor = 0.5 / np.sqrt(SURFACE_POINTS)
    assert found.accuracy == pytest.approx(0.4 * 0.2 + 0.6 * floor, abs=0.004)
    assert found.completeness == pytest.approx(found.accuracy, abs=0.004)
    assert found.hausdorff == pytest.approx(0.4, abs=0.01)


def test_two_samples_of_one_surface_are_as_far_apart_as_documented():
    sphere = trimesh.creation.icosphere(4, 0.8)
    found = surface_distance(points_of(sphere, 0), points_of(sphere, 1))
    assert found.chamfer == pytest.approx(np.sqrt(sphere.area / SURFACE_POINTS), rel=0.03)
    assert found.hausdorff < 0.06


def test_surface_that_is_not_there_and_surface_that_lacks_are_told_apart():
    near, far = np.zeros((3, 3)), np.array([[0.0, 0.0, 2.0]])
    extra = surface_distance(np.concatenate([near, far]), near)
    assert extra == (0.5, 0.0, 2.0)
    assert surface_distance(near, np.concatenate([near, far])) == (0.0, 0.5, 2.0)


@pytest.mark.parametrize(("points", "message"), [(np.zeros((0, 3)), "no points"), (np.full((1, 3), np.inf), "finite")])
def test_bad_points_are_named(points, message):
    good = np.zeros((2, 3))
    with pytest.raises(InputError, match=f"reconstruction has.*{message}"):
        surface_distance(points, good)
    with pytest.raises(InputError, match=f"true surface has.*{message}"):
        surface_distance(good, points)
