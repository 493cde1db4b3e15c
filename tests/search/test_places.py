"""Where a sensor can stand: a turntable, an arm's reach."""

import math

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxnbv as nbv

UP = (0.6, 0.0, 0.8)


def elevations(poses, up):
    places = np.asarray(poses.position, np.float64)
    return np.arcsin(places @ np.array(up) / np.linalg.norm(places, axis=1))


@pytest.mark.parametrize("key", [None, jax.random.key(1)])
@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), UP])
def test_a_turntable_is_a_circle_in_even_steps(up, key):
    table = nbv.Turntable(8, 2.0, math.radians(25.0), up)
    poses = table.poses(key)
    places = np.asarray(poses.position, np.float64)
    assert table.count == len(places) == 8
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 2.0, rtol=1e-6)
    np.testing.assert_allclose(elevations(poses, up), math.radians(25.0), atol=1e-6)
    steps = np.linalg.norm(np.roll(places, -1, axis=0) - places, axis=1)
    # The chord of 45 degrees on the circle of radius 2 cos 25.
    np.testing.assert_allclose(steps, 2 * 2.0 * math.cos(math.radians(25.0)) * math.sin(math.pi / 8), rtol=1e-5)
    np.testing.assert_allclose(poses.forward, -places / 2.0, atol=1e-6)
    # The camera's y axis points down.
    assert (np.asarray(poses.rotation)[:, :, 1] @ np.array(up) < -0.8).all()


@settings(max_examples=30, deadline=None)
@given(st.floats(0.5, 2.0), st.floats(0.0, 2.0), st.floats(-1.5, 1.4), st.floats(0.05, 1.0), st.booleans())
def test_an_arm_reaches_between_its_bounds(nearest, more, low, wider, turned):
    high = min(low + wider, 0.5 * math.pi)
    reach = nbv.Reach(40, nearest, nearest + more, low, high, UP)
    poses = reach.poses(jax.random.key(0) if turned else None)
    distance = np.linalg.norm(np.asarray(poses.position, np.float64), axis=1)
    assert reach.count == len(distance) == 40
    assert (distance >= nearest - 1e-5).all()
    assert (distance <= nearest + more + 1e-5).all()
    assert (elevations(poses, UP) >= low - 1e-4).all()
    assert (elevations(poses, UP) <= high + 1e-4).all()
    np.testing.assert_allclose(poses.forward, -np.asarray(poses.position) / distance[:, None], atol=1e-5)


def test_an_arm_s_places_are_even_in_its_volume():
    """In boxes of equal volume, by height and by the cube of the distance: binomial would be 12.5 +- 3.4."""
    reach = nbv.Reach(200, 1.0, 3.0, 0.0, math.radians(80.0))
    places = np.asarray(reach.poses().position, np.float64)
    distance = np.linalg.norm(places, axis=1)
    height = places[:, 1] / distance / math.sin(math.radians(80.0))
    counts, *_ = np.histogram2d(height, (distance**3 - 1.0) / 26.0, bins=4, range=[(0, 1), (0, 1)])
    assert np.abs(counts - 12.5).max() <= 4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: nbv.Turntable(0), "0 candidates"),
        (lambda: nbv.Turntable(8, -1.0), "radius of -1.0"),
        (lambda: nbv.Turntable(8, 2.0, 1.6), "elevation is 1.6 rad"),
        (lambda: nbv.Turntable(8, up=(0.0, 0.0, 0.0)), "must be a direction"),
        (lambda: nbv.Reach(8, 3.0, 2.0), "distances of 3.0 to 2.0"),
        (lambda: nbv.Reach(8, min_elevation=1.0, max_elevation=0.5), "elevations are 1.0 and 0.5 rad"),
    ],
)
def test_places_that_cannot_be_are_named(make, message):
    with pytest.raises(nbv.InputError, match=message):
        make()
