"""Costs of travel between views, against closed forms, and their effect on a view's value."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_planner import FIRST, SCENE, planner_of

from jaxnbv.checks import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.observations import Observations
from jaxnbv.planning.travel import ValuePerCost, arc_length, total_cost
from jaxnbv.scanning import scan
from jaxnbv.search import (
    DiscreteSearch,
    FarthestView,
    GivenPoses,
    GradientSearch,
    HalvingSearch,
    RandomView,
    UncertaintyView,
)

RNG, KEY = np.random.default_rng(0), jax.random.key(3)


def observations_of(planner):
    return planner.init(FIRST, scan(SCENE, planner.camera, FIRST))


def random_poses(count):
    return Pose(Rotation.random(count, rng=RNG).as_matrix(), RNG.normal(size=(count, 3)))


def test_on_a_sphere_the_way_is_its_great_circle():
    a, b = look_at((2.0, 0.0, 0.0)), look_at((0.0, 0.0, -2.0))
    assert float(arc_length(a, b)) == pytest.approx(np.pi, rel=1e-5)
    assert float(arc_length(a, look_at((-2.0, 1e-5, 0.0)))) == pytest.approx(2.0 * np.pi, rel=1e-4)
    assert float(arc_length(a, look_at((2.0, 0.0, 1e-3)))) == pytest.approx(1e-3, rel=1e-3)
    # Towards the centre it is straight.
    assert float(arc_length(look_at((3.0, 0.0, 0.0)), look_at((1.0, 0.0, 0.0)))) == pytest.approx(2.0, rel=1e-6)
    way = float(arc_length(look_at((3.0, 0.0, 0.0)), look_at((0.0, 1.0, 0.0), up=(0.0, 0.0, 1.0))))
    assert way == pytest.approx(np.hypot(2.0 * np.pi / 2.0, 2.0), rel=1e-6)


def test_staying_costs_nothing_and_has_a_derivative():
    pose = look_at((1.0, 0.5, 2.0))
    assert float(arc_length(pose, pose)) == pytest.approx(0.0, abs=1e-3)
    gradient = jax.grad(lambda end: arc_length(pose, end))(pose)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))


def test_the_derivative_of_the_way_is_that_of_its_differences():
    start, end = look_at((1.0, 0.5, 2.0)), np.array([-1.0, 1.5, 0.7])

    def way(position):
        return arc_length(start, Pose(jnp.eye(3), position))

    gradient = np.asarray(jax.grad(way)(jnp.asarray(end, jnp.float32)))
    step = 1e-2
    differences = [
        float(way(jnp.asarray(end + d, jnp.float32)) - way(jnp.asarray(end - d, jnp.float32))) / (2.0 * step)
        for d in step * np.eye(3)
    ]
    np.testing.assert_allclose(gradient, differences, atol=2e-3)


def test_a_cost_that_breaks_its_contract_makes_a_value_of_nothing():
    """Zero is a valid cost. Negative and non-finite costs are not."""
    costs = jnp.array([-1.0, 0.0, jnp.inf, jnp.nan, 2.0])
    poses = Pose(jnp.broadcast_to(jnp.eye(3), (5, 3, 3)), jnp.zeros((5, 3)).at[:, 1].set(jnp.arange(5.0)))
    cloud = PointCloud.from_arrays(np.eye(3), np.eye(3))
    observations = Observations.start(cloud, 1, None)
    weighed = ValuePerCost(lambda start, end: costs[end.position[1].astype(int)], fixed=0.5)
    np.testing.assert_array_equal(weighed(jnp.ones(5), observations, poses), 2.0)
    observations = dataclasses.replace(observations, poses=observations.poses.append(poses[0]))
    np.testing.assert_allclose(weighed(jnp.ones(5), observations, poses), [np.nan, 2.0, np.nan, np.nan, 0.4])


@pytest.mark.parametrize(
    ("search", "cost", "worth"),
    [
        (DiscreteSearch(12), ValuePerCost(arc_length, fixed=0.5), lambda value, way: value / (0.5 + way)),
        (
            HalvingSearch(12, num_first_samples=3),
            ValuePerCost(lambda a, b: 2.0 * arc_length(a, b)),
            lambda value, way: value / (1.0 + 2.0 * way),
        ),
        (UncertaintyView(12), ValuePerCost(arc_length, fixed=0.5), lambda value, way: value / (0.5 + way)),
    ],
)
def test_values_are_weighed_against_the_way_from_the_last_view(cost, worth, search):
    plain, weighed = planner_of(search), planner_of(search, cost=cost)
    observations = observations_of(plain)
    second = plain.propose(observations, KEY).pose
    observations = plain.observe(observations, second, scan(SCENE, plain.camera, second))
    proposals = [planner.propose(observations, KEY) for planner in (plain, weighed)]
    values, per_cost = (np.asarray(proposal.values) for proposal in proposals)
    places = np.asarray(plain.search.candidates.poses().position, np.float64)
    here = np.asarray(second.position, np.float64)
    angle = np.arccos(np.clip(places @ here / np.linalg.norm(places, axis=1) / np.linalg.norm(here), -1.0, 1.0))
    expected = worth(values, 2.5 * angle)
    # The other candidates dropped out in the first rounds of halving, which have fewer samples.
    open_ = np.isfinite(values)
    np.testing.assert_allclose(per_cost[open_], expected[open_], rtol=2e-3, atol=5e-3)
    errors, weighed_errors = (proposal.standard_errors for proposal in proposals)
    if errors is not None:
        expected = worth(np.asarray(errors), 2.5 * angle)
        np.testing.assert_allclose(weighed_errors[open_], expected[open_], rtol=2e-3, atol=5e-3)


@pytest.mark.slow
def test_a_search_by_gradient_weighs_the_way_too():
    """Along its ascents a value is the value without cost, by the same samples, divided by the cost of travel."""
    search = GradientSearch(dof=2, num_starts=2, iterations=6, learning_rate=0.05, num_candidates=6)
    planner = planner_of(search, cost=ValuePerCost(arc_length, fixed=1.0))
    observations = observations_of(planner)
    ways = planner.propose(observations, KEY).trajectories
    poses = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), ways.poses)
    plain = planner_of(DiscreteSearch(GivenPoses(poses))).propose(observations, KEY)
    costs = [1.0 + float(arc_length(FIRST, poses[index])) for index in range(ways.values.size)]
    np.testing.assert_allclose(np.ravel(ways.values), np.asarray(plain.values) / costs, rtol=1e-3)
    assert planner.quantity.name == "expected coverage gain per cost"


def test_without_a_last_view_nothing_is_spent():
    planner = planner_of(cost=ValuePerCost(arc_length))
    observations = planner.init(None, scan(SCENE, planner.camera, FIRST))
    plain = planner_of().propose(observations, KEY)
    np.testing.assert_allclose(planner.propose(observations, KEY).values, plain.values, rtol=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ValuePerCost(arc_length, fixed=0.0), "fixed cost of a view is 0.0; it must be positive"),
        (lambda: planner_of(FarthestView(12), cost=ValuePerCost(arc_length)), "does not look at the value of a view"),
        (lambda: planner_of(RandomView(12), cost=ValuePerCost(arc_length)), "does not look at the value of a view"),
        (lambda: total_cost(list(random_poses(2)), lambda a, b: -1.0), "is -1.0: make it one finite number"),
        (lambda: total_cost(list(random_poses(2)), lambda a, b: jnp.inf), "is inf: make it one finite number"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
