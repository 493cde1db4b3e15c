"""Searches over candidates by their scores (discrete, halving, tie-break) against loops over poses, samples and
rounds."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problem import KEY, POSES, Constant, Height, propose, sample_by_sample, three_balls, visit, with_samples

import jaxnbv as nbv
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.sampler import StepInputs
from jaxnbv.search.base import best_unvisited

SEARCH, PROBLEM = nbv.DiscreteSearch(12), three_balls()


class Once(nbv.Coverage):
    """Coverage with no gain left at visited poses."""

    gains_once = True


class ConstantGain(Constant):
    gains_once = True


def test_the_argmax_of_values_recomputed_one_by_one():
    proposal = propose(SEARCH, PROBLEM)
    values = [sample_by_sample(PROBLEM, poses=pose[None]).mean() for pose in POSES]
    np.testing.assert_allclose(proposal.values, values, rtol=1e-5)
    best = int(np.argmax(values))
    assert np.sort(values)[-1] > 1.01 * np.sort(values)[-2]
    np.testing.assert_allclose(proposal.candidates.position, nbv.geometry.fibonacci_sphere(12, 2.5), atol=1e-6)
    np.testing.assert_allclose(proposal.pose.position, POSES.position[best], atol=1e-6)
    np.testing.assert_allclose(proposal.pose.rotation, POSES.rotation[best], atol=1e-6)
    assert float(proposal.value) == pytest.approx(float(values[best]), rel=1e-5)


def test_visited_views_are_excluded_one_after_the_other():
    values = np.asarray(propose(SEARCH, PROBLEM).values)
    order, visited = np.argsort(-values), []
    for rank in range(4):
        proposal = propose(SEARCH, visit(PROBLEM, *visited))
        np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[order[rank]])
        np.testing.assert_array_equal(np.isneginf(proposal.values), np.isin(np.arange(12), order[:rank]))
        visited.append(proposal.pose)


def test_only_the_same_place_and_direction_counts_as_visited():
    best = propose(SEARCH, PROBLEM).pose
    elsewhere = nbv.look_at(best.position, target=(0.0, 0.3, 0.1))
    aside = nbv.look_at(best.position + jnp.array([0.01, 0.0, 0.0]))
    turned = nbv.look_at(best.position, up=(0.0, 0.0, 1.0))
    for pose, is_visited in [(best, True), (turned, True), (elsewhere, False), (aside, False)]:
        again = propose(SEARCH, visit(PROBLEM, pose))
        assert bool((again.pose.position != best.position).any()) == is_visited
    # Rows beyond the number of views do not count.
    stale = eqx.tree_at(lambda p: p.inputs.observations.poses.count, visit(PROBLEM, best), jnp.asarray(0))
    np.testing.assert_array_equal(propose(SEARCH, stale).pose.position, best.position)


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
def test_values_equal_up_to_rounding_tie_and_the_first_wins(values, expected):
    best = best_unvisited(PROBLEM, POSES[:4], jnp.asarray(values))
    np.testing.assert_array_equal(best.pose.position, POSES.position[expected])
    assert float(best.value) == np.float32(values[expected])


def test_standard_errors_are_those_of_the_scores_sample_by_sample():
    proposal, scores = propose(SEARCH, PROBLEM), sample_by_sample(PROBLEM)
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
    again = propose(SEARCH, visit(PROBLEM, proposal.pose))
    assert not again.tied_with_best()[np.argmax(proposal.values)]


@pytest.mark.parametrize("taken", [(), (3,), (3, 8)])
def test_tied_gains_choose_the_farthest_candidate(taken):
    """A tie is within two standard errors and, from the second view on, the mean expectation at visited poses."""
    problem = visit(PROBLEM.with_acquisition(Once()), *[POSES[index] for index in taken])
    scores, is_open = sample_by_sample(PROBLEM), ~np.isin(np.arange(12), taken)
    values = np.where(is_open, scores.mean(axis=0), -np.inf)
    differences = scores[:, [values.argmax()]] - scores
    in_vain = scores.mean(axis=0)[list(taken)].mean() if len(taken) > 1 else 0.0
    level = differences.mean(axis=0) <= 2.0 * differences.std(axis=0, ddof=1) / np.sqrt(3) + in_vain
    places = np.asarray(POSES.position)
    away = np.linalg.norm(places[:, None] - places[list(taken)], axis=-1).min(axis=1, initial=np.inf)
    expected = np.argmax(np.where(level & is_open, away, -np.inf)) if taken else values.argmax()
    assert (level & is_open).sum() > 1
    proposal = propose(SEARCH, problem)
    assert float(proposal.value_at_visited) == pytest.approx(in_vain, rel=1e-4)
    np.testing.assert_array_equal(proposal.tied_with_best()[is_open], level[is_open])
    np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[expected])
    assert float(proposal.value) == pytest.approx(values[expected], rel=1e-5)
    assert float(proposal.standard_error) == pytest.approx(float(proposal.standard_errors[expected]))


@pytest.mark.parametrize("count", [0, 1, 2, 8, 11])
def test_errors_are_those_at_the_latest_eight_poses(count):
    """The list has room for twelve poses. Rows after the last view do not count."""
    poses = PoseList(POSES, jnp.asarray(count))
    problem = eqx.tree_at(lambda p: p.inputs.observations.poses, PROBLEM.with_acquisition(Once()), poses)
    means = sample_by_sample(PROBLEM).mean(axis=0)
    expected = means[max(0, count - 8) : count].mean() if count > 1 else 0.0
    assert float(propose(SEARCH, problem).value_at_visited) == pytest.approx(expected, rel=1e-4)


def test_travel_counts_among_tied_gains():
    here, cost = nbv.look_at(jnp.array([0.0, 0.0, 2.5])), nbv.ValuePerCost(nbv.arc_length, fixed=1e-3)
    problem = dataclasses.replace(visit(PROBLEM.with_acquisition(Once()), here), cost=cost)
    proposal = propose(SEARCH, problem)
    assert float(proposal.value) == float(proposal.values.max())
    assert proposal.value_at_visited is None


def test_one_sample_has_no_standard_errors():
    alone = propose(SEARCH, with_samples(PROBLEM, slice(0, 1)))
    assert alone.num_tied is None
    np.testing.assert_array_equal(np.isnan(alone.standard_errors), True)


@pytest.mark.parametrize(("num_visited", "first"), [(0, 1), (1, 1), (0, 3)])
def test_rounds_of_halving_recomputed(num_visited, first):
    table, left, values, scored = sample_by_sample(PROBLEM), np.arange(12), np.zeros(12), 0
    while scored < 3:
        if scored:
            left = left[np.argsort(-values[left], kind="stable")[: len(left) // 2]]
        scored = min(max(2 * scored, first), 3)
        values[left] = table[:scored, left].mean(axis=0)
        values[:num_visited] = -np.inf
    problem = visit(PROBLEM, *[POSES[i] for i in range(num_visited)])
    proposal = propose(nbv.HalvingSearch(12, num_first_samples=first), problem)
    best = left[np.argmax(values[left])]
    np.testing.assert_allclose(proposal.values, values, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(proposal.pose.position, POSES.position[best], atol=1e-6)
    assert float(proposal.value) == pytest.approx(values[best], rel=1e-4)


@eqx.filter_jit
def score(search, problem):
    return search.score(problem, search.candidates.poses())


@pytest.mark.parametrize("visited", [(), (3, 8)])
def test_halving_proposes_what_it_picks_by_the_scores_of_all_samples(visited):
    search, problem = nbv.HalvingSearch(12, num_first_samples=1), visit(PROBLEM, *[POSES[index] for index in visited])
    pick = eqx.filter_jit(lambda problem, scores: search.pick(problem, search.candidates.poses(), scores, KEY))
    proposal, expected = pick(problem, score(search, problem)), propose(search, problem)
    assert jax.tree.structure(proposal) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, proposal.pose, expected.pose)
    for one, other in zip(jax.tree.leaves(proposal), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("search", "acquisitions"),
    [
        (nbv.search.TieBreakSearch(12, second=Height()), (nbv.Coverage(), Height())),
        (nbv.HalvingSearch(12, num_first_samples=1), (nbv.Coverage(),)),
        (nbv.RandomView(12), ()),
    ],
)
def test_scores_are_by_sample_and_acquisition(search, acquisitions):
    result = score(search, PROBLEM)
    assert search.acquisitions(nbv.Coverage()) == acquisitions
    assert result.shape == ((len(acquisitions), 3, 12) if acquisitions else (0, 0, 12))
    for scores, acquisition in zip(result, acquisitions, strict=True):
        np.testing.assert_allclose(scores, sample_by_sample(PROBLEM, acquisition), rtol=1e-5, atol=1e-6)


def test_without_samples_it_says_so():
    bare = dataclasses.replace(PROBLEM, inputs=StepInputs(PROBLEM.observations))
    for kind in (nbv.DiscreteSearch, nbv.HalvingSearch, nbv.search.UncertaintyView):
        with pytest.raises(ValueError, match="uses_samples"):
            kind(12).propose(bare, KEY)


def tie_break(problem, second):
    return propose(nbv.search.TieBreakSearch(12, second=second), problem)


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_the_second_score_chooses_among_ties_of_the_first(factor):
    first, second = sample_by_sample(PROBLEM), sample_by_sample(PROBLEM, Height(factor)).mean(axis=0)
    mean = first.mean(axis=0)
    difference = first[:, [mean.argmax()]] - first
    level = difference.mean(axis=0) <= 2.0 * difference.std(axis=0, ddof=1) / np.sqrt(3)
    assert 1 < level.sum() < 12
    expected = int(np.argmax(np.where(level, second, -np.inf)))
    proposal = tie_break(PROBLEM, Height(factor))
    assert expected != int(np.argmin(np.where(level, second, np.inf)))
    np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[expected])
    assert float(proposal.value) == pytest.approx(mean[expected], rel=1e-5)
    np.testing.assert_allclose(proposal.values, mean, rtol=1e-5)


def test_the_second_score_decides_only_ties():
    proposal = tie_break(PROBLEM.with_acquisition(Constant(1.0)), nbv.Coverage())
    np.testing.assert_array_equal(proposal.pose.position, propose(nbv.DiscreteSearch(12), PROBLEM).pose.position)
    # Equal samples determine the first score exactly, and so does a single sample.
    for rows in (jnp.zeros(3, int), slice(0, 1)):
        other = tie_break(with_samples(PROBLEM, rows), Height())
        assert float(other.value) == float(other.values.max())


def test_a_tie_break_does_not_choose_visited_views():
    problem, visited = PROBLEM.with_acquisition(Constant(0.0)), []
    for _ in range(3):
        visited.append(tie_break(visit(problem, *visited), Height()).pose)
    heights = np.sort(sample_by_sample(PROBLEM, Height()).mean(axis=0))[::-1]
    of = [sample_by_sample(PROBLEM, Height(), pose[None]).mean() for pose in visited]
    np.testing.assert_allclose(of, heights[:3], rtol=1e-5)


def test_travel_decides_ties_of_both_scores():
    """Among candidates that tie except for travel the nearest one wins, whatever the second score."""
    here, cost = nbv.look_at(jnp.array([0.0, 0.0, 2.5])), nbv.ValuePerCost(nbv.arc_length, fixed=1e-3)
    problem = dataclasses.replace(visit(PROBLEM.with_acquisition(Constant(1.0)), here), cost=cost)
    proposal = tie_break(problem, Height())
    distances = np.linalg.norm(np.asarray(proposal.candidates.position - here.position), axis=1)
    np.testing.assert_array_equal(proposal.pose.position, proposal.candidates.position[distances.argmin()])


def test_scores_of_nan_are_reported():
    assert np.isnan(float(tie_break(PROBLEM, Constant(np.nan)).value))
    assert np.isnan(float(propose(SEARCH, PROBLEM.with_acquisition(ConstantGain(np.nan))).value))
