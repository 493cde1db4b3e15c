"""Search that asks a second acquisition where samples cannot tell by the first: against the rule, in NumPy."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_discrete import CAMERA, problem, visit

from jaxnbv.acquisition import Acquisition, expected_value
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.planning.travel import ValueMinusCost, arc_length
from jaxnbv.search import DiscreteSearch, TieBreakSearch
from jaxnbv.tasks import Coverage

__all__ = ["problem"]


class Height(Acquisition):
    """How high the middle of what a scan shows is, times a factor."""

    factor: float = 1.0

    def context(self, cloud):
        return None

    def __call__(self, context, scan):
        return self.factor * jnp.sum(jnp.where(scan.mask, scan.points[:, 1], 0.0)) / jnp.maximum(scan.count, 1)


class Constant(Acquisition):
    """All scans are worth the same."""

    value: float

    def context(self, cloud):
        return None

    def __call__(self, context, scan):
        return jnp.asarray(self.value)


@eqx.filter_jit
def search(problem, second, kind=TieBreakSearch):
    return kind(12, second=second).propose(problem, jax.random.key(0))


def sample_by_sample(score, problem):
    poses, value = look_at(fibonacci_sphere(12, 2.5)), eqx.filter_jit(expected_value)
    one = [jax.tree.map(lambda leaf, s=s: leaf[s : s + 1], problem.surfaces) for s in range(3)]
    return np.array([value(score, problem.evidence.cloud, surface, CAMERA, poses) for surface in one], np.float64)


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_the_best_by_the_second_score_of_those_that_are_tied_by_the_first(problem, factor):
    first, second = sample_by_sample(Coverage(), problem), sample_by_sample(Height(factor), problem).mean(axis=0)
    mean = first.mean(axis=0)
    difference = first[:, [mean.argmax()]] - first
    level = difference.mean(axis=0) <= 2.0 * difference.std(axis=0, ddof=1) / np.sqrt(3)
    assert 1 < level.sum() < 12
    expected = int(np.argmax(np.where(level, second, -np.inf)))
    proposal = search(problem, Height(factor))
    assert expected != int(np.argmin(np.where(level, second, np.inf)))
    np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[expected])
    assert float(proposal.value) == pytest.approx(mean[expected], rel=1e-5)
    np.testing.assert_allclose(proposal.values, mean, rtol=1e-5)


def test_where_the_first_tells_nothing_the_second_decides_and_where_it_tells_all_the_first_does(problem):
    told = problem.about(Constant(1.0))
    np.testing.assert_array_equal(
        search(told, Coverage()).pose.position, DiscreteSearch(12).propose(problem, jax.random.key(0)).pose.position
    )
    same = jax.tree.map(lambda leaf: jnp.repeat(leaf[:1], 3, axis=0), problem.surfaces)
    certain = eqx.tree_at(lambda p: p.surfaces, problem, same)
    for factor in (1.0, -1.0):
        found = search(certain, Height(factor))
        assert float(found.value) == float(found.values.max())


def test_of_one_sample_the_first_score_decides(problem):
    alone = eqx.tree_at(lambda p: p.surfaces, problem, jax.tree.map(lambda leaf: leaf[:1], problem.surfaces))
    found = search(alone, Height())
    assert float(found.value) == float(found.values.max())


def test_visited_views_are_not_chosen(problem):
    told, taken = problem.about(Constant(0.0)), []
    for _ in range(3):
        taken.append(search(visit(told, *taken) if taken else told, Height()).pose)
    heights = np.sort(sample_by_sample(Height(), problem).mean(axis=0))[::-1]
    of = [expected_value(Height(), problem.evidence.cloud, problem.surfaces, CAMERA, pose[None])[0] for pose in taken]
    np.testing.assert_allclose(of, heights[:3], rtol=1e-5)


def test_the_way_there_counts(problem):
    """Among candidates that are level but for their way the nearest is taken, whatever the second score."""
    here, cost = look_at(jnp.array([0.0, 0.0, 2.5])), ValueMinusCost(arc_length, weight=1e3)
    told = dataclasses.replace(visit(problem.about(Constant(1.0)), here), cost=cost)
    found = search(told, Height())
    distances = np.linalg.norm(np.asarray(found.candidates.position - here.position), axis=1)
    np.testing.assert_array_equal(found.pose.position, found.candidates.position[distances.argmin()])


def test_a_second_score_that_is_no_number_is_told_of(problem):
    assert np.isnan(float(search(problem, Constant(np.nan)).value))
