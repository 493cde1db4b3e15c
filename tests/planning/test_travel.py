"""What it costs to go from view to view: against closed forms, SciPy and brute force."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxnbv.checks import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.planning.travel import ValuePerCost, arc_length, rotation_angle, total_cost, visiting_order
from jaxnbv.scanning import Evidence

RNG = np.random.default_rng(0)


def random_poses(count):
    return Pose(Rotation.random(count, rng=RNG).as_matrix(), RNG.normal(size=(count, 3)))


def test_on_a_sphere_the_way_is_its_great_circle():
    a, b = look_at((2.0, 0.0, 0.0)), look_at((0.0, 0.0, -2.0))
    assert float(arc_length(a, b)) == pytest.approx(np.pi, rel=1e-5)
    assert float(arc_length(a, look_at((-2.0, 1e-5, 0.0)))) == pytest.approx(2.0 * np.pi, rel=1e-4)
    assert float(arc_length(a, look_at((2.0, 0.0, 1e-3)))) == pytest.approx(1e-3, rel=1e-3)


def test_towards_the_centre_the_way_is_straight():
    assert float(arc_length(look_at((3.0, 0.0, 0.0)), look_at((1.0, 0.0, 0.0)))) == pytest.approx(2.0, rel=1e-6)
    way = float(arc_length(look_at((3.0, 0.0, 0.0)), look_at((0.0, 1.0, 0.0), up=(0.0, 0.0, 1.0))))
    assert way == pytest.approx(np.hypot(2.0 * np.pi / 2.0, 2.0), rel=1e-6)


def test_the_angle_of_a_turn_is_scipys():
    poses = random_poses(50)
    rotations = Rotation.from_matrix(np.asarray(poses.rotation, np.float64))
    for i, j in zip(range(0, 50, 2), range(1, 50, 2), strict=True):
        expected = (rotations[i].inv() * rotations[j]).magnitude()
        assert float(rotation_angle(poses[i], poses[j])) == pytest.approx(expected, abs=2e-3)


def test_small_turns_are_told_apart():
    turned = Pose(Rotation.from_rotvec([0.0, 1e-3, 0.0]).as_matrix(), np.zeros(3))
    assert float(rotation_angle(Pose(np.eye(3), np.zeros(3)), turned)) == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("cost", [arc_length, rotation_angle])
def test_staying_costs_nothing_and_has_a_derivative(cost):
    pose = look_at((1.0, 0.5, 2.0))
    assert float(cost(pose, pose)) == pytest.approx(0.0, abs=1e-3)
    gradient = jax.grad(lambda pose: cost(look_at((1.0, 0.5, 2.0)), pose))(pose)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))


def test_the_derivative_of_the_way_is_that_of_its_differences():
    start, end = look_at((1.0, 0.5, 2.0)), np.array([-1.0, 1.5, 0.7])

    def way(position):
        return arc_length(start, Pose(jnp.eye(3), position))

    found = np.asarray(jax.grad(way)(jnp.asarray(end, jnp.float32)))
    step = 1e-2
    differences = [
        float(way(jnp.asarray(end + d, jnp.float32)) - way(jnp.asarray(end - d, jnp.float32))) / (2.0 * step)
        for d in step * np.eye(3)
    ]
    np.testing.assert_allclose(found, differences, atol=2e-3)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 6), st.integers(0, 10_000))
def test_the_order_is_the_best_of_all(count, seed):
    rng = np.random.default_rng(seed)
    poses = Pose(np.tile(np.eye(3), (count, 1, 1)), rng.normal(size=(count, 3)))
    start = Pose(np.eye(3), rng.normal(size=3))

    def distance(a, b):
        return jnp.linalg.norm(a.position - b.position)

    def length(order):
        places = np.concatenate([start.position[None], np.asarray(poses.position)[list(order)]])
        return np.linalg.norm(np.diff(places, axis=0), axis=1).sum()

    found = visiting_order(start, poses, distance)
    assert sorted(found) == list(range(count))
    assert length(found) == pytest.approx(min(map(length, itertools.permutations(range(count)))), rel=1e-5)
    way = [start, *(poses[index] for index in found)]
    assert total_cost(way, distance) == pytest.approx(length(found), rel=1e-5)


def test_a_cost_that_breaks_its_contract_makes_a_value_of_nothing():
    """Zero is a cost; less, and what is not finite, is none."""
    costs = jnp.array([-1.0, 0.0, jnp.inf, jnp.nan, 2.0])
    poses = Pose(jnp.broadcast_to(jnp.eye(3), (5, 3, 3)), jnp.zeros((5, 3)).at[:, 1].set(jnp.arange(5.0)))
    cloud = PointCloud.from_arrays(np.eye(3), np.eye(3))
    seen = Evidence.before_views(cloud, 1, None)
    weighed = ValuePerCost(lambda start, end: costs[end.position[1].astype(int)], fixed=0.5)
    np.testing.assert_array_equal(weighed(jnp.ones(5), seen, poses), 2.0)
    seen = dataclasses.replace(seen, num_views=seen.num_views + 1)
    np.testing.assert_allclose(weighed(jnp.ones(5), seen, poses), [np.nan, 2.0, np.nan, np.nan, 0.4])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ValuePerCost(arc_length, fixed=0.0), "fixed cost of a view is 0.0; it must be positive"),
        (lambda: visiting_order(look_at((0.0, 0.0, 1.0)), random_poses(13)), "order of 13 poses: give at most 12"),
        (lambda: total_cost(list(random_poses(2)), lambda a, b: -1.0), "is -1.0: make it one finite number"),
        (lambda: total_cost(list(random_poses(2)), lambda a, b: jnp.inf), "is inf: make it one finite number"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(InputError, match=message):
        make()
