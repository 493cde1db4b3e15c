"""The discrete search: the argmax of values recomputed pose by pose, without the views taken before."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import balls

from jaxnbv.acquisition import expected_value
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.scanning import Evidence, Grid
from jaxnbv.search import DiscreteSearch, Problem, SphereCandidates
from jaxnbv.search.base import best_unvisited
from jaxnbv.tasks import Coverage

CAMERA, GRID = Camera(height=8, width=8), Grid(20)
SEARCH = DiscreteSearch(12)


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    surfaces = balls(GRID, (0.8, 0.6, 0.9), rng.uniform(-0.5, 0.5, (3, 3)))
    cloud = PointCloud.from_arrays(rng.uniform(-1, 1, (30, 3)), np.tile([0.0, 1.0, 0.0], (30, 1)), 32)
    visited = Pose(np.tile(np.eye(3, dtype=np.float32), (4, 1, 1)), np.zeros((4, 3), np.float32))
    return Problem(Evidence(cloud, visited, jnp.asarray(0)), CAMERA, Coverage(), surfaces).prepared()


def visit(problem, *poses):
    rows = jax.tree.map(lambda *leaves: jnp.stack(leaves), *poses)
    taken = jax.tree.map(lambda all_rows, new: all_rows.at[: len(poses)].set(new), problem.evidence.poses, rows)
    evidence = dataclasses.replace(problem.evidence, poses=taken, num_views=jnp.asarray(len(poses)))
    return dataclasses.replace(problem, evidence=evidence)


@eqx.filter_jit
def search(problem, seed=0):
    return SEARCH.propose(problem, jax.random.key(seed))


def test_the_argmax_of_values_recomputed_one_by_one(problem):
    proposal = search(problem)
    value, values = eqx.filter_jit(expected_value), []
    for position in np.asarray(fibonacci_sphere(12, 2.5)):
        pose = look_at(position[None])
        values.append(value(Coverage(), problem.evidence.cloud, problem.surfaces, CAMERA, pose)[0])
    np.testing.assert_allclose(proposal.values, values, rtol=1e-5)
    best = int(np.argmax(values))
    assert np.sort(values)[-1] > 1.01 * np.sort(values)[-2]
    np.testing.assert_allclose(proposal.pose.position, fibonacci_sphere(12, 2.5)[best], atol=1e-6)
    np.testing.assert_allclose(proposal.pose.rotation, look_at(proposal.pose.position).rotation, atol=1e-6)
    assert float(proposal.value) == pytest.approx(float(values[best]), rel=1e-5)
    np.testing.assert_allclose(proposal.candidates.position, fibonacci_sphere(12, 2.5), atol=1e-6)


def test_visited_views_are_excluded_one_after_the_other(problem):
    values = np.asarray(search(problem).values)
    order, taken = np.argsort(-values), []
    for rank in range(4):
        proposal = search(visit(problem, *taken) if taken else problem)
        np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[order[rank]])
        np.testing.assert_array_equal(np.isneginf(proposal.values), np.isin(np.arange(12), order[:rank]))
        taken.append(proposal.pose)


def test_only_the_same_place_and_direction_counts_as_visited(problem):
    best = search(problem).pose
    elsewhere = look_at(best.position, target=(0.0, 0.3, 0.1))
    aside = look_at(best.position + jnp.array([0.01, 0.0, 0.0]))
    turned = look_at(best.position, up=(0.0, 0.0, 1.0))
    for pose, is_visited in [(best, True), (turned, True), (elsewhere, False), (aside, False)]:
        again = search(visit(problem, pose))
        assert bool((again.pose.position != best.position).any()) == is_visited


def test_rows_beyond_the_views_taken_hold_nothing(problem):
    best = search(problem).pose
    stale = eqx.tree_at(lambda p: p.evidence.num_views, visit(problem, best), jnp.asarray(0))
    np.testing.assert_array_equal(search(stale).pose.position, best.position)


def test_it_is_deterministic(problem):
    a, b = search(problem), search(problem, 7)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.5, 1.0, 1.000001, 0.9], 1),
        ([0.5, 1.0, 1.001, 0.9], 2),
        ([-3.0, -1.000001, -1.0, -2.0], 1),
        ([0.0, 0.0, 1e-30, 0.0], 2),
        ([1.0, -np.inf, np.inf, np.inf], 2),
        ([-np.inf] * 4, 0),
    ],
)
def test_values_that_rounding_may_turn_round_tie_and_the_first_is_taken(problem, values, expected):
    poses = SphereCandidates(4).poses()
    found = best_unvisited(problem, poses, jnp.asarray(values))
    np.testing.assert_array_equal(found.pose.position, poses.position[expected])
    assert float(found.value) == np.float32(values[expected])


def test_standard_errors_are_those_of_the_scores_sample_by_sample(problem):
    proposal = search(problem)
    value, poses = eqx.filter_jit(expected_value), look_at(fibonacci_sphere(12, 2.5))
    scores = np.array(
        [
            value(
                Coverage(),
                problem.evidence.cloud,
                jax.tree.map(lambda leaf, s=s: leaf[s : s + 1], problem.surfaces),
                CAMERA,
                poses,
            )
            for s in range(3)
        ],
        np.float64,
    )
    best = scores.mean(axis=0).argmax()
    expected = scores.std(axis=0, ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(proposal.standard_errors, expected, rtol=1e-4)
    differences = scores - scores[:, [best]]
    of_differences = differences.std(axis=0, ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(proposal.difference_errors, of_differences, rtol=1e-3, atol=1e-5)
    for errors in (0.5, 2.0, 5.0):
        level = -differences.mean(axis=0) <= errors * of_differences
        np.testing.assert_array_equal(proposal.tied_with_best(errors), level)
    assert proposal.num_tied == np.sum(-differences.mean(axis=0) <= 2.0 * of_differences) - 1
    assert 0 < proposal.num_tied < 11


def test_a_visited_view_is_tied_with_none_and_of_one_sample_nothing_is_known(problem):
    first = search(problem)
    again = search(visit(problem, first.pose))
    assert not again.tied_with_best()[np.argmax(first.values)]
    alone = eqx.tree_at(lambda p: p.surfaces, problem, jax.tree.map(lambda leaf: leaf[:1], problem.surfaces))
    assert search(alone).num_tied is None
    np.testing.assert_array_equal(np.isnan(search(alone).standard_errors), True)
