"""Candidates: places, orientations, and every search with a user's own poses."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problem import propose, three_balls, visit

import jaxnbv as nbv
from jaxnbv.search.candidates import as_candidates, sphere_candidates

DOME = nbv.SphereCandidates(50, 2.0, math.radians(20.0))


def positions(candidates):
    return np.asarray(candidates.poses().position, np.float64)


def test_the_whole_sphere_is_the_papers_lattice():
    poses = nbv.SphereCandidates(30, 2.5).poses()
    np.testing.assert_array_equal(poses.position, nbv.geometry.fibonacci_sphere(30, 2.5))
    np.testing.assert_allclose(poses.forward, -poses.position / 2.5, atol=1e-6)
    np.testing.assert_array_equal(sphere_candidates(30).position, poses.position)
    assert nbv.SphereCandidates().count == len(positions(nbv.SphereCandidates())) == 120


def test_a_dome_covers_what_is_above_its_elevation_evenly():
    height = positions(DOME)[:, 1] / 2.0
    least = math.sin(math.radians(20.0))
    # Uniform by area is uniform in height (Archimedes). The k-th of n heights is the middle of its share.
    np.testing.assert_allclose(np.sort(height), least + (1 - least) * (np.arange(50) + 0.5) / 50, atol=1e-6)


def test_up_turns_places_and_images():
    up = np.array([0.0, 0.6, -0.8])
    tilted = nbv.SphereCandidates(50, 2.0, math.radians(20.0), tuple(up.tolist()))
    poses = tilted.poses()
    assert (np.asarray(poses.position) @ up / 2.0 >= math.sin(math.radians(20.0)) - 1e-6).all()
    # The camera's y axis points down.
    assert (np.asarray(poses.rotation)[:, :, 1] @ up <= 1e-6).all()
    # The dome has the same distances between places as the one about y.
    plain, turned = positions(DOME), positions(tilted)
    np.testing.assert_allclose(_distances(turned), _distances(plain), atol=1e-5)
    below = nbv.SphereCandidates(50, 2.0, math.radians(20.0), (0.0, -1.0, 0.0))
    assert (positions(below)[:, 1] < 0).all()


def _distances(points):
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


UP = (0.6, 0.0, 0.8)


def elevations(poses, up):
    places = np.asarray(poses.position, np.float64)
    return np.arcsin(places @ np.array(up) / np.linalg.norm(places, axis=1))


@settings(max_examples=30)
@given(st.floats(0.5, 2.0), st.floats(0.0, 2.0), st.floats(-1.5, 1.4), st.floats(0.05, 1.0))
def test_an_arm_reaches_between_its_bounds(nearest, more, low, wider):
    high = min(low + wider, 0.5 * math.pi)
    reach = nbv.Reach(40, nearest, nearest + more, low, high, UP)
    poses = reach.poses()
    distance = np.linalg.norm(np.asarray(poses.position, np.float64), axis=1)
    assert reach.count == len(distance) == 40
    assert (distance >= nearest - 1e-5).all()
    assert (distance <= nearest + more + 1e-5).all()
    assert (elevations(poses, UP) >= low - 1e-4).all()
    assert (elevations(poses, UP) <= high + 1e-4).all()
    np.testing.assert_allclose(poses.forward, -np.asarray(poses.position) / distance[:, None], atol=1e-5)


def test_an_arm_s_places_are_even_in_its_volume():
    """Counts in boxes of equal volume, by height and by the cube of the distance. Binomial counts would be 12.5 +-
    3.4."""
    reach = nbv.Reach(200, 1.0, 3.0, 0.0, math.radians(80.0))
    places = np.asarray(reach.poses().position, np.float64)
    distance = np.linalg.norm(places, axis=1)
    height = places[:, 1] / distance / math.sin(math.radians(80.0))
    counts, *_ = np.histogram2d(height, (distance**3 - 1.0) / 26.0, bins=4, range=[(0, 1), (0, 1)])
    assert np.abs(counts - 12.5).max() <= 4


def test_a_predicate_keeps_what_it_allows():
    subset = nbv.SphereCandidates(40).where(lambda pose: pose.position[0] > 1.0)
    every = positions(nbv.SphereCandidates(40))
    np.testing.assert_array_equal(positions(subset), every[every[:, 0] > 1.0])
    assert subset.count == (every[:, 0] > 1.0).sum() > 3
    again = subset.where(lambda pose: pose.position[1] > 0)
    assert 0 < again.count < subset.count


def test_numbers_and_poses_stand_for_candidates():
    assert as_candidates(7) == nbv.SphereCandidates(7)
    poses = sphere_candidates(3, 2.0)
    np.testing.assert_array_equal(as_candidates(poses).poses().position, poses.position)
    assert as_candidates(DOME) is DOME


@pytest.mark.parametrize("kind", [nbv.DiscreteSearch, nbv.HalvingSearch, nbv.FarthestView, nbv.RandomView])
def test_every_search_chooses_among_the_poses_it_is_given(kind):
    given = DOME.where(lambda pose: pose.position[2] < 0)
    search = kind(given)
    proposal = propose(search, visit(three_balls(), given.poses()[0]))
    np.testing.assert_array_equal(proposal.candidates.position, positions(given).astype(np.float32))
    assert proposal.values[0] == -jnp.inf
    chosen = int(np.argmax(proposal.values))
    np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[chosen])
