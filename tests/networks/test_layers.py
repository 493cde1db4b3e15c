"""Ball queries and interpolation against loops in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.networks.layers import ball_query, interpolate

RNG = np.random.default_rng(0)


def lattice(side):
    return np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


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


@pytest.mark.parametrize(("n", "count"), [(1, 4), (31, 8), (200, 64), (200, 256)])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_balls_against_a_loop(x64, n, count, share):
    points, mask = RNG.uniform(-1, 1, (n, 3)), some_mask(n, share)
    filled = np.where(mask[:, None], points, RNG.choice([np.nan, 0.0], size=(n, 1)))
    centers = np.concatenate([points[mask][:30], RNG.uniform(-1, 1, (10, 3))])
    for radius in (0.05, 0.5, 1.2, 9.0):
        indices = ball_query(jnp.asarray(centers), jnp.asarray(filled), jnp.asarray(mask), radius, count)
        np.testing.assert_array_equal(indices, ball_by_loop(centers, points, mask, radius, count))


def test_a_point_on_the_sphere_is_within():
    points = lattice(5)
    mask = np.ones(len(points), bool)
    for radius in (1.0, 2.0, 3.0):
        indices = ball_query(jnp.asarray(points), jnp.asarray(points), jnp.asarray(mask), radius, 90)
        np.testing.assert_array_equal(indices, ball_by_loop(points, points, mask, radius, 90))


def interpolated_by_loop(points, coarse, features):
    result = np.zeros((len(points), features.shape[1]))
    for i, x in enumerate(points):
        squared = {j: ((x - y) ** 2).sum() for j, y in enumerate(coarse)}
        nearest = sorted(squared, key=squared.get)[:3]
        weights = [1 / (squared[j] + 1e-8) for j in nearest]
        for j, w in zip(nearest, weights, strict=True):
            result[i] += w / sum(weights) * features[j]
    return result


@pytest.mark.parametrize("m", [1, 2, 40])
def test_interpolation_against_a_loop(x64, m):
    points, coarse, features = RNG.normal(size=(30, 3)), RNG.normal(size=(m, 3)), RNG.normal(size=(m, 5))
    points[0] = coarse[0]
    np.testing.assert_allclose(
        jax.jit(interpolate)(points, coarse, features), interpolated_by_loop(points, coarse, features), atol=1e-12
    )


def test_gradients_are_bounded_however_close_the_coarse_points_are():
    """In single precision, with weights that span eight orders of magnitude. Two coarse points coincide."""
    coarse = jnp.asarray([[0.0, 0, 0], [0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]])
    features = jnp.asarray([[1.0], [1.0], [2.0], [3.0]])
    both = jax.jit(jax.value_and_grad(lambda x, y: interpolate(x, y, features)[0, 0], argnums=(0, 1)))
    for distance in (0.0, 1e-5, 1e-4, 1e-2):
        value, gradient = both(jnp.asarray([[0.0, 0, distance]]), coarse)
        assert all(np.isfinite(g).all() and np.abs(g).max() < 100 for g in gradient)
        assert float(value) == pytest.approx(1.0, abs=0.02)
