"""Volumes: distances from boxes against brute force, and points on a volume's boundary."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.geometry.volume import boundary_points

RNG = np.random.default_rng(0)
LOW, HIGH = np.array([-0.5, 0.2, -1.0]), np.array([0.4, 0.9, 1.2])
OFF_CENTRE = nbv.Box(tuple(LOW.tolist()), tuple(HIGH.tolist()))


def points_on_faces(low, high, count):
    """A lattice of count^2 points on each of the six faces, edges included."""
    u, v = (steps.ravel() for steps in np.meshgrid(*[np.linspace(0.0, 1.0, count)] * 2))
    faces = [np.insert(np.stack([u, v], axis=1), axis, side, axis=1) for axis in range(3) for side in (0.0, 1.0)]
    return low + np.concatenate(faces) * (high - low)


def test_box_distances_against_the_nearest_of_many_surface_points(x64):
    x = RNG.uniform(LOW - 0.4, HIGH + 0.4, (400, 3))
    surface = points_on_faces(LOW, HIGH, 60)
    nearest = np.sqrt(((x[:, None] - surface) ** 2).sum(-1).min(axis=1))
    inside = ((x > LOW) & (x < HIGH)).all(axis=1)
    distance = np.asarray(OFF_CENTRE(x))
    assert 20 < inside.sum() < 380
    np.testing.assert_array_equal(distance < 0, inside)
    # A lattice point lies within half a cell's diagonal of the surface's nearest point.
    half_cell = 0.5 * np.hypot(1.2, 2.2) / 59
    assert (np.abs(distance) <= nearest + 1e-12).all()
    np.testing.assert_allclose(np.abs(distance), nearest, atol=half_cell)
    np.testing.assert_allclose(OFF_CENTRE(surface), 0.0, atol=1e-12)


def ellipsoid(x):
    """An implicit function of an ellipsoid with half axes 0.9, 0.5 and 0.7, smaller in magnitude than the distance."""
    return 0.5 * (jnp.sqrt(jnp.sum((x / jnp.asarray([0.9, 0.5, 0.7])) ** 2, axis=-1)) - 1.0)


BOUNDARIES = {
    "default box": (nbv.Box(), lambda p: np.abs(p).max(axis=1) - 1.25),
    "box off the centre": (
        nbv.Box((-0.3, -1.1, -0.2), (1.2, 0.4, 0.9)),
        lambda p: np.maximum([-0.3, -1.1, -0.2] - p, p - [1.2, 0.4, 0.9]).max(axis=1),
    ),
    "ball": (nbv.sdf.Sphere(0.8), lambda p: np.linalg.norm(p, axis=1) - 0.8),
    "callable": (ellipsoid, lambda p: np.linalg.norm(p / [0.9, 0.5, 0.7], axis=1) - 1.0),
}


@pytest.mark.parametrize("name", BOUNDARIES)
def test_boundary_points_lie_on_the_boundary_all_around(name):
    volume, zero_on_boundary = BOUNDARIES[name]
    points = np.asarray(boundary_points(volume, 300), np.float64)
    np.testing.assert_allclose(zero_on_boundary(points), 0.0, atol=2e-6)
    # Every direction has a point nearby: each of 300 cells of the sphere has a radius of about 0.12.
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    probes = RNG.normal(size=(500, 3))
    cosines = (probes / np.linalg.norm(probes, axis=1, keepdims=True)) @ directions.T
    assert np.arccos(cosines.max(axis=1)).max() < 0.3


def test_the_share_of_points_beyond_each_face():
    box = nbv.Box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = np.array([[1.2, 1.0, 1.0], [1.05, 1.0, 3.3], [0.5, -0.2, 1.0], [0.5, 1.0, 1.0]])
    shares = box.shares_beyond(points, 0.1)
    assert shares == {"-x": 0.0, "+x": 0.25, "-y": 0.25, "+y": 0.0, "-z": 0.0, "+z": 0.25}
    assert box.shares_beyond(points[:0], 0.1) == {}


def test_a_program_runs_for_any_box():
    """The program is not traced again."""
    traced = []

    @eqx.filter_jit
    def middle(box):
        traced.append(box)
        return 0.5 * (box.low + box.high)

    for box in (nbv.Box(), OFF_CENTRE):
        np.testing.assert_allclose(middle(box), 0.5 * (box.low + box.high), atol=1e-6)
    assert len(traced) == 1


def test_equal_boxes_are_one_key():
    assert {nbv.Box(): 1}[nbv.Box.cube(2.5)] == 1
    assert nbv.Box() not in {OFF_CENTRE: 1}
