"""Several views at once, and what it costs to go there: against brute force over pairs on a tiny problem."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_planner import FIRST, SCENE, planner_of

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.checks import InputError
from jaxnbv.geometry.pose import look_at
from jaxnbv.planning.travel import ValuePerCost, arc_length, total_cost
from jaxnbv.scanning import scan, scan_samples
from jaxnbv.search import (
    DiscreteSearch,
    FarthestView,
    GradientSearch,
    HalvingSearch,
    RandomView,
    UncertaintyView,
)
from jaxnbv.tasks import Coverage

KEY = jax.random.key(3)


def spread(cloud):
    """How far points reach along each axis: a utility whose improvements are not sums over points."""
    return jnp.sum(jnp.max(jnp.where(cloud.mask[:, None], jnp.abs(cloud.points), 0.0), axis=0))


def evidence_of(planner):
    return planner.init(FIRST, scan(SCENE, planner.camera, FIRST))


def rows(cloud):
    return np.asarray(cloud.points, np.float64)[np.asarray(cloud.mask)]


def coverage_gain(known, seen):
    """In float64, by all pairs."""
    if not len(seen):
        return 0.0
    return float((np.linalg.norm(seen[:, None] - known[None], axis=-1).min(axis=1) ** 2).sum())


def spread_gain(known, seen):
    before = np.abs(known).max(axis=0).sum()
    return max(0.0, np.abs(np.concatenate([known, seen])).max(axis=0).sum() - before)


@pytest.mark.parametrize(
    ("score", "gain"), [(Coverage(), coverage_gain), (ExpectedUtilityImprovement(spread), spread_gain)]
)
def test_a_batch_is_greedy_over_what_the_same_sample_would_show(score, gain):
    planner = planner_of(score=score)
    evidence = evidence_of(planner)
    batch = planner.propose_batch(evidence, KEY, 3)
    surfaces = planner.imagination.sample(evidence, jax.random.split(KEY)[0])
    poses = planner.search.candidates.poses()
    scans = scan_samples(surfaces, planner.camera, poses)
    seen = [[rows(scans[s][p]) for p in range(12)] for s in range(3)]
    known, taken = [rows(evidence.cloud)] * 3, []
    for proposal in batch.proposals:
        values = np.array([np.mean([gain(known[s], seen[s][p]) for s in range(3)]) for p in range(12)])
        found = np.asarray(proposal.values)
        open_ = [p for p in range(12) if p not in taken]
        np.testing.assert_allclose(found[open_], values[open_], rtol=1e-3, atol=1e-4)
        assert np.isneginf(found[taken]).all()
        best = max(open_, key=lambda p: values[p])
        np.testing.assert_allclose(proposal.pose.position, poses.position[best], atol=1e-6)
        known = [np.concatenate([known[s], seen[s][best]]) for s in range(3)]
        taken.append(best)
    single = planner.propose(evidence, KEY)
    np.testing.assert_array_equal(batch.proposals[0].pose.position, single.pose.position)


def test_what_the_first_view_shows_is_worth_little_to_the_second():
    """Two neighbours: alone they are level."""
    candidates = look_at(np.array([[2.5, 0.1, 0.0], [2.5, -0.1, 0.0]]))
    planner = planner_of(DiscreteSearch(candidates))
    first, second = planner.propose_batch(evidence_of(planner), KEY, 2).proposals
    other = 1 - int(jnp.argmax(first.values))
    assert float(first.values[other]) > 0.8 * float(first.value)
    assert float(second.value) < 0.5 * float(first.values[other])


def test_the_order_is_that_of_the_shortest_way():
    planner = planner_of(FarthestView(12))
    evidence = evidence_of(planner)
    batch = planner.propose_batch(evidence, KEY, 4)

    def length(order):
        return total_cost([FIRST, *(batch.poses[index] for index in order)])

    assert length(batch.order) == pytest.approx(min(map(length, itertools.permutations(range(4)))), rel=1e-5)
    from_first = dataclasses.replace(batch, start=None)
    assert from_first.order[0] == 0
    assert len({tuple(np.asarray(pose.position).round(4).tolist()) for pose in batch.poses}) == 4


def test_a_second_batch_compiles_nothing(compilations):
    planner = planner_of()
    evidence, other = evidence_of(planner), jax.random.key(9)
    planner.propose_batch(evidence, KEY, 3)
    before = len(compilations)
    planner.propose_batch(evidence, other, 3)
    assert len(compilations) == before


PER_COST = ValuePerCost(arc_length, fixed=0.5), lambda value, cost: value / (0.5 + cost)


@pytest.mark.parametrize(
    ("search", "cost", "worth"),
    [
        (DiscreteSearch(12), *PER_COST),
        (HalvingSearch(12, num_first_samples=3), *PER_COST),
        (UncertaintyView(12), *PER_COST),
        (
            DiscreteSearch(12),
            ValuePerCost(lambda a, b: 2.0 * arc_length(a, b)),
            lambda value, cost: value / (1.0 + 2.0 * cost),
        ),
    ],
)
def test_values_are_weighed_against_the_way_from_the_last_view(cost, worth, search):
    plain, weighed = planner_of(search), planner_of(search, cost=cost)
    evidence = evidence_of(plain)
    second = plain.propose(evidence, KEY).pose
    evidence = plain.observe(evidence, second, scan(SCENE, plain.camera, second))
    values, found = (np.asarray(planner.propose(evidence, KEY).values) for planner in (plain, weighed))
    places = np.asarray(plain.search.candidates.poses().position, np.float64)
    here = np.asarray(second.position, np.float64)
    angle = np.arccos(np.clip(places @ here / np.linalg.norm(places, axis=1) / np.linalg.norm(here), -1.0, 1.0))
    expected = worth(values, 2.5 * angle)
    # The others left the rounds of halving early, by other samples.
    open_ = np.isfinite(values)
    np.testing.assert_allclose(found[open_], expected[open_], rtol=2e-3, atol=5e-3)


def test_standard_errors_are_of_what_is_weighed():
    plain, weighed = planner_of(), planner_of(cost=ValuePerCost(arc_length))
    evidence = evidence_of(plain)
    errors = [np.asarray(planner.propose(evidence, KEY).standard_errors) for planner in (plain, weighed)]
    way = np.array([float(arc_length(FIRST, pose)) for pose in plain.search.candidates.poses()])
    np.testing.assert_allclose(errors[1], errors[0] / (1.0 + way), rtol=1e-3)


@pytest.mark.slow
def test_a_search_by_gradient_weighs_the_way_too():
    """So dear that the best is to stay near."""
    search = GradientSearch(dof=2, num_starts=2, iterations=6, learning_rate=0.05, num_candidates=6)
    planner = planner_of(search, cost=ValuePerCost(arc_length, fixed=1e-3))
    proposal = planner.propose(evidence_of(planner), KEY)
    ways = np.array([[float(arc_length(FIRST, p)) for p in way] for way in proposal.trajectories.poses])
    assert np.all(ways[:, -1] < ways[:, 0])
    assert planner.quantity.name == "expected coverage gain per cost"


def test_without_a_last_view_nothing_is_spent():
    planner = planner_of(cost=ValuePerCost(arc_length))
    evidence = planner.init(None, scan(SCENE, planner.camera, FIRST))
    plain = planner_of().propose(evidence, KEY)
    np.testing.assert_allclose(planner.propose(evidence, KEY).values, plain.values, rtol=1e-5)
    assert planner.propose_batch(evidence, KEY, 2).start is None


@pytest.mark.parametrize("search", [FarthestView(12), RandomView(12)])
def test_what_does_not_look_at_values_takes_no_cost(search):
    with pytest.raises(InputError, match="does not look at the value of a view"):
        planner_of(search, cost=ValuePerCost(arc_length))


@pytest.mark.parametrize("count", [0, 6])
def test_a_batch_needs_room(count):
    planner = planner_of()
    with pytest.raises(InputError, match=f"asked for {count} views at once; give 1 to 5"):
        planner.propose_batch(evidence_of(planner), KEY, count)
