"""Candidates as a value: where they stand, how they are turned, and every search with poses of one's own."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problem import propose, three_balls, visit

import jaxnbv as nbv
from jaxnbv.search.candidates import as_candidates, sphere_candidates

DOME = nbv.SphereCandidates(50, 2.0, math.radians(20.0))


def positions(candidates, key=None):
    return np.asarray(candidates.poses(key).position, np.float64)


def test_the_whole_sphere_is_the_papers_lattice():
    poses = nbv.SphereCandidates(30, 2.5).poses()
    np.testing.assert_array_equal(poses.position, nbv.fibonacci_sphere(30, 2.5))
    np.testing.assert_allclose(poses.forward, -poses.position / 2.5, atol=1e-6)
    np.testing.assert_array_equal(sphere_candidates(30).position, poses.position)
    assert nbv.SphereCandidates().count == len(positions(nbv.SphereCandidates())) == 120


@pytest.mark.parametrize("key", [None, jax.random.key(3)])
def test_a_dome_covers_what_is_above_its_elevation_evenly(key):
    height = positions(DOME, key)[:, 1] / 2.0
    least = math.sin(math.radians(20.0))
    # Uniform by area is uniform in height (Archimedes): the k-th of n heights is the middle of its share.
    np.testing.assert_allclose(np.sort(height), least + (1 - least) * (np.arange(50) + 0.5) / 50, atol=1e-6)


def test_up_turns_places_and_images():
    up = np.array([0.0, 0.6, -0.8])
    tilted = nbv.SphereCandidates(50, 2.0, math.radians(20.0), tuple(up.tolist()))
    poses = tilted.poses()
    assert (np.asarray(poses.position) @ up / 2.0 >= math.sin(math.radians(20.0)) - 1e-6).all()
    # The camera's y axis points down.
    assert (np.asarray(poses.rotation)[:, :, 1] @ up <= 1e-6).all()
    # And stands as the one about y does: the same distances between places.
    plain, turned = positions(DOME), positions(tilted)
    np.testing.assert_allclose(_distances(turned), _distances(plain), atol=1e-5)
    below = nbv.SphereCandidates(50, 2.0, math.radians(20.0), (0.0, -1.0, 0.0))
    assert (positions(below)[:, 1] < 0).all()


def _distances(points):
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


@pytest.mark.parametrize("candidates", [DOME, nbv.SphereCandidates(20)])
def test_a_key_turns_them_as_one(candidates):
    one, other = (positions(candidates, jax.random.key(seed)) for seed in (0, 1))
    np.testing.assert_allclose(_distances(one), _distances(positions(candidates)), atol=1e-5)
    assert np.abs(one - other).max() > 0.1
    np.testing.assert_array_equal(one, positions(candidates, jax.random.key(0)))


def test_a_predicate_keeps_what_it_allows():
    kept = nbv.SphereCandidates(40).where(lambda pose: pose.position[0] > 1.0)
    every = positions(nbv.SphereCandidates(40))
    np.testing.assert_array_equal(positions(kept), every[every[:, 0] > 1.0])
    assert kept.count == (every[:, 0] > 1.0).sum() > 3
    again = kept.where(lambda pose: pose.position[1] > 0)
    assert 0 < again.count < kept.count
    with pytest.raises(nbv.InputError, match="none of 40 candidates is allowed"):
        nbv.SphereCandidates(40).where(lambda pose: False)


def test_numbers_and_poses_stand_for_candidates():
    assert as_candidates(7) == nbv.SphereCandidates(7)
    poses = sphere_candidates(3, 2.0)
    np.testing.assert_array_equal(as_candidates(poses).poses(jax.random.key(0)).position, poses.position)
    assert as_candidates(DOME) is DOME
    for wrong in ("many", 2.5, None):
        with pytest.raises(nbv.InputError, match="give how many"):
            as_candidates(wrong)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "0 candidates"),
        ((10, 0.0), "radius of 0.0"),
        ((10, math.inf), "radius is inf; it must be a finite number"),
        ((10, 2.5, 2.0), "elevation is 2.0 rad"),
        ((10, 2.5, 0.0, (0.0, 0.0, 0.0)), "must be a direction"),
    ],
)
def test_bad_numbers_are_named(arguments, message):
    with pytest.raises(nbv.InputError, match=message):
        nbv.SphereCandidates(*arguments)
    with pytest.raises(nbv.InputError, match="give a batch"):
        nbv.GivenPoses(nbv.look_at((0.0, 0.0, 2.0)))


@pytest.mark.parametrize("kind", [nbv.DiscreteSearch, nbv.HalvingSearch, nbv.FarthestView, nbv.RandomView])
def test_every_search_chooses_among_the_poses_it_is_given(kind):
    given = DOME.where(lambda pose: pose.position[2] < 0)
    search = kind(given)
    found = propose(search, visit(three_balls(), given.poses()[0]))
    np.testing.assert_array_equal(found.candidates.position, positions(given).astype(np.float32))
    assert found.values[0] == -jnp.inf
    chosen = int(np.argmax(found.values))
    np.testing.assert_array_equal(found.pose.position, found.candidates.position[chosen])
