"""Search that asks a second acquisition where samples cannot tell by the first: against the rule, in NumPy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from small_problem import Constant, Height, propose, sample_by_sample, three_balls, visit, with_samples

from jaxnbv.geometry.pose import look_at
from jaxnbv.planning.travel import ValuePerCost, arc_length
from jaxnbv.search import DiscreteSearch, TieBreakSearch
from jaxnbv.tasks import Coverage

PROBLEM = three_balls()


def search(problem, second):
    return propose(TieBreakSearch(12, second=second), problem)


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_the_best_by_the_second_score_of_those_that_are_tied_by_the_first(factor):
    first, second = sample_by_sample(PROBLEM), sample_by_sample(PROBLEM, Height(factor)).mean(axis=0)
    mean = first.mean(axis=0)
    difference = first[:, [mean.argmax()]] - first
    level = difference.mean(axis=0) <= 2.0 * difference.std(axis=0, ddof=1) / np.sqrt(3)
    assert 1 < level.sum() < 12
    expected = int(np.argmax(np.where(level, second, -np.inf)))
    proposal = search(PROBLEM, Height(factor))
    assert expected != int(np.argmin(np.where(level, second, np.inf)))
    np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[expected])
    assert float(proposal.value) == pytest.approx(mean[expected], rel=1e-5)
    np.testing.assert_allclose(proposal.values, mean, rtol=1e-5)


def test_where_the_first_tells_nothing_the_second_decides_and_where_it_tells_all_the_first_does():
    told = search(PROBLEM.about(Constant(1.0)), Coverage())
    np.testing.assert_array_equal(told.pose.position, propose(DiscreteSearch(12), PROBLEM).pose.position)
    # Samples that are all alike tell all, and a single one too.
    for rows in (jnp.zeros(3, int), slice(0, 1)):
        found = search(with_samples(PROBLEM, rows), Height())
        assert float(found.value) == float(found.values.max())


def test_visited_views_are_not_chosen():
    told, taken = PROBLEM.about(Constant(0.0)), []
    for _ in range(3):
        taken.append(search(visit(told, *taken), Height()).pose)
    heights = np.sort(sample_by_sample(PROBLEM, Height()).mean(axis=0))[::-1]
    of = [sample_by_sample(PROBLEM, Height(), pose[None]).mean() for pose in taken]
    np.testing.assert_allclose(of, heights[:3], rtol=1e-5)


def test_the_way_there_counts():
    """Among candidates that are level but for their way the nearest is taken, whatever the second score."""
    here, cost = look_at(jnp.array([0.0, 0.0, 2.5])), ValuePerCost(arc_length, fixed=1e-3)
    told = dataclasses.replace(visit(PROBLEM.about(Constant(1.0)), here), cost=cost)
    found = search(told, Height())
    distances = np.linalg.norm(np.asarray(found.candidates.position - here.position), axis=1)
    np.testing.assert_array_equal(found.pose.position, found.candidates.position[distances.argmin()])


def test_a_second_score_that_is_no_number_is_told_of():
    assert np.isnan(float(search(PROBLEM, Constant(np.nan)).value))
