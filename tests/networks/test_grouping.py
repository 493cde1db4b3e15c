"""Farthest point sampling and ball queries against loops in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.networks.layers import ball_query

RNG = np.random.default_rng(0)


def lattice(side):
    return np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def farthest_by_loop(points, mask, count):
    rows = np.flatnonzero(mask)
    chosen = [rows[0]]
    while len(chosen) < min(count, len(rows)):
        distance = ((points[rows, None] - points[chosen]) ** 2).sum(axis=-1).min(axis=1)
        distance[np.isin(rows, chosen)] = -1.0
        chosen.append(rows[np.argmax(distance)])
    return np.array(chosen + rows[:1].tolist() * (count - len(chosen)))


def ball_by_loop(centers, points, mask, radius, count):
    groups = []
    for center in centers:
        within = [j for j in np.flatnonzero(mask) if ((points[j] - center) ** 2).sum() <= radius**2][:count]
        within = within or [np.flatnonzero(mask)[0]]
        groups.append(within + within[:1] * (count - len(within)))
    return np.array(groups)


def some_mask(n, share):
    mask = RNG.random(n) < share
    mask[RNG.integers(n)] = True
    return mask


@pytest.mark.parametrize("n", [1, 31, 32, 33, 257])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_farthest_points_against_a_loop_and_masked_rows_may_hold_anything(x64, n, share):
    points, mask = RNG.normal(size=(n, 3)), some_mask(n, share)
    filled = np.where(mask[:, None], points, RNG.choice([np.nan, np.inf, 1e9], size=(n, 1)))
    count = 20
    found = farthest_point_indices(jnp.asarray(filled), jnp.asarray(mask), count)
    np.testing.assert_array_equal(found, farthest_by_loop(points, mask, count))
    assert len(set(np.asarray(found).tolist())) == min(count, mask.sum())


def test_of_points_equally_far_the_first_is_chosen():
    points = lattice(5)
    for mask in (np.ones(len(points), bool), some_mask(len(points), 0.5)):
        found = farthest_point_indices(jnp.asarray(points), jnp.asarray(mask), 60)
        np.testing.assert_array_equal(found, farthest_by_loop(points, mask, 60))


def test_duplicates_come_last_and_then_the_first_filled_row_again_and_again():
    points = np.repeat(RNG.integers(0, 9, (6, 3)).astype(np.float32), 3, axis=0)
    mask = np.arange(18) >= 4
    found = np.asarray(farthest_point_indices(jnp.asarray(points), jnp.asarray(mask), 30))
    np.testing.assert_array_equal(found, farthest_by_loop(points, mask, 30))
    assert sorted(map(tuple, points[found[:5]])) == sorted(set(map(tuple, points[mask])))
    assert sorted(found[:14]) == list(range(4, 18))
    np.testing.assert_array_equal(found[14:], 4)
    np.testing.assert_array_equal(farthest_point_indices(jnp.asarray(points), jnp.zeros(18, bool), 3), 0)


@pytest.mark.parametrize(("n", "count"), [(1, 1), (1, 4), (31, 8), (64, 40), (200, 64), (200, 256)])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_balls_against_a_loop(x64, n, count, share):
    points, mask = RNG.uniform(-1, 1, (n, 3)), some_mask(n, share)
    filled = np.where(mask[:, None], points, RNG.choice([np.nan, 0.0], size=(n, 1)))
    centers = np.concatenate([points[mask][:30], RNG.uniform(-1, 1, (10, 3))])
    for radius in (0.05, 0.5, 1.2, 9.0):
        found = ball_query(jnp.asarray(centers), jnp.asarray(filled), jnp.asarray(mask), radius, count)
        np.testing.assert_array_equal(found, ball_by_loop(centers, points, mask, radius, count))


def test_a_point_on_the_sphere_is_within():
    points = lattice(5)
    mask = np.ones(len(points), bool)
    for radius in (1.0, 2.0, 3.0):
        found = ball_query(jnp.asarray(points), jnp.asarray(points), jnp.asarray(mask), radius, 90)
        np.testing.assert_array_equal(found, ball_by_loop(points, points, mask, radius, 90))


def test_under_vmap_and_map_as_one_by_one():
    points = jnp.asarray(RNG.normal(size=(4, 90, 3)), jnp.float32)
    mask = jnp.asarray(RNG.random((4, 90)) < 0.6)

    def rows(points, mask):
        chosen = farthest_point_indices(points, mask, 12)
        return chosen, ball_query(points[chosen], points, mask, 0.7, 9)

    one_by_one = [rows(points[i], mask[i]) for i in range(4)]
    for together in (jax.vmap(rows)(points, mask), jax.lax.map(lambda cloud: rows(*cloud), (points, mask))):
        for i, (chosen, groups) in enumerate(one_by_one):
            np.testing.assert_array_equal(together[0][i], chosen)
            np.testing.assert_array_equal(together[1][i], groups)


def test_gradients_reach_points_through_the_gathers_only(x64):
    points, mask = jnp.asarray(RNG.normal(size=(40, 3))), jnp.ones(40, bool)

    def spread(points):
        centers = points[farthest_point_indices(points, mask, 6)]
        return jnp.sum((points[ball_query(centers, points, mask, 1.0, 5)] - centers[:, None]) ** 2)

    chosen = np.asarray(farthest_point_indices(points, mask, 6))
    groups = np.asarray(ball_query(points[chosen], points, mask, 1.0, 5))
    expected = np.zeros((40, 3))
    for i, group in zip(chosen, groups, strict=True):
        for j in group:
            expected[j] += 2 * np.asarray(points[j] - points[i])
            expected[i] -= 2 * np.asarray(points[j] - points[i])
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(jax.grad(spread)(points), expected, atol=1e-12)


def test_counts_below_one_are_refused():
    with pytest.raises(InputError, match="at least one"):
        farthest_point_indices(jnp.zeros((3, 3)), jnp.ones(3, bool), 0)
    with pytest.raises(InputError, match="at least one"):
        ball_query(jnp.zeros((3, 3)), jnp.zeros((3, 3)), jnp.ones(3, bool), 1.0, 0)
