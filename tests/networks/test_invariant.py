"""The invariant network, and the one that sees only the points that tell the class: their invariances and
derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.networks import CloudClassifier, InvariantClassifier

pytestmark = pytest.mark.usefixtures("x64")
RNG = np.random.default_rng(0)
# Rows of most clouds, which then share one program.
COUNT = 300


@functools.cache
def network():
    """An untrained network whose outputs differ between clouds by some tenths."""
    net = eqx.filter_jit(InvariantClassifier)(5, jax.random.key(0))
    return eqx.tree_at(lambda n: n.temperature, net, net.temperature * 0.02)


def oriented(count, extent=1.0):
    points, normals = extent * RNG.uniform(-1, 1, (count, 3)), RNG.normal(size=(count, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@eqx.filter_jit
def call(net, *arguments):
    return net(*arguments)


def answer(net, points, normals, mask=None):
    mask = np.ones(len(points), bool) if mask is None else mask
    return np.asarray(call(net, jnp.asarray(points), jnp.asarray(normals), jnp.asarray(mask)))


@eqx.filter_jit
def value_and_slopes(net, points, normals, mask):
    return jax.value_and_grad(lambda rows: net(*rows, mask)[0])((points, normals))


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 2e-2)])
def test_rotations_and_translations_do_not_matter(dtype, tolerance):
    """The choice of rows by distances is invariant too, because random points have no ties that rounding could
    break."""
    net = jax.tree.map(lambda leaf: leaf.astype(dtype), network())
    points, normals = oriented(COUNT)
    still = answer(net, points.astype(dtype), normals.astype(dtype))
    assert still.dtype == dtype
    for seed in range(3):
        turn = Rotation.random(random_state=seed).as_matrix()
        moved = points @ turn.T + RNG.uniform(-1, 1, 3)
        np.testing.assert_allclose(
            answer(net, moved.astype(dtype), (normals @ turn.T).astype(dtype)), still, atol=tolerance
        )
    mirror = np.diag([1.0, 1.0, -1.0])
    np.testing.assert_allclose(
        answer(net, (points @ mirror).astype(dtype), (normals @ mirror).astype(dtype)), still, atol=tolerance
    )
    for other in ((0.8 * points, normals), (points, normals @ turn.T)):
        assert np.abs(answer(net, *(rows.astype(dtype) for rows in other)) - still).max() > 5 * tolerance


def test_masked_rows_and_the_capacity_do_not_matter():
    """Masked rows may be anywhere and hold anything, as long as the filled rows keep their order."""
    points, normals = oriented(40)
    still = call(network(), jnp.asarray(points), jnp.asarray(normals))
    rows = np.sort(RNG.choice(COUNT, 40, replace=False))
    for junk in (0.0, 1e6, np.nan):
        padded = np.full((2, COUNT, 3), junk)
        padded[:, rows] = points, normals
        np.testing.assert_allclose(answer(network(), *padded, np.isin(np.arange(COUNT), rows)), still, atol=1e-12)


def test_the_order_of_rows_after_the_first_does_not_matter_where_no_ball_is_overfull():
    """The sampling starts at the first row, and an overfull ball takes its first 24 rows.

    Balls of centres are filled in the order of sampling, which depends on the points and not on the rows.
    """
    net = network()
    points, normals = oriented(COUNT)
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    assert (distance <= 0.25).sum(axis=1).max() <= 24
    assert (distance <= 0.8).sum(axis=1).max() > 48
    still = answer(net, points, normals)
    for _ in range(3):
        order = np.concatenate([[0], 1 + RNG.permutation(COUNT - 1)])
        np.testing.assert_allclose(answer(net, points[order], normals[order]), still, atol=1e-12)
    points = 0.3 * points
    assert (0.3 * distance <= 0.25).sum(axis=1).max() > 24
    assert np.abs(answer(net, points[order], normals[order]) - answer(net, points, normals)).max() > 1e-6


@pytest.mark.parametrize("count", [30, COUNT])
def test_gradients_against_central_differences(count):
    """Normals are rotated, not stretched. Points alone in their balls all tie, with equal slopes for unit normals."""
    rows = [jnp.asarray(a) for a in oriented(COUNT)]
    mask = jnp.arange(COUNT) < count
    for argument, slope in enumerate(value_and_slopes(network(), *rows, mask)[1]):
        assert np.abs(slope).max() > 1e-3
        assert not np.asarray(slope)[count:].any()
        for _ in range(2):
            along = jnp.asarray(RNG.normal(size=(COUNT, 3)))
            if argument == 1:
                along = along - jnp.sum(along * rows[1], axis=1, keepdims=True) * rows[1]
            ends = []
            for step in (-1e-7, 1e-7):
                moved = list(rows)
                moved[argument] = rows[argument] + step * along
                ends.append(float(value_and_slopes(network(), *moved, mask)[0]))
            assert float(jnp.sum(slope * along)) == pytest.approx((ends[1] - ends[0]) / 2e-7, rel=1e-5, abs=1e-7)


def test_duplicates_and_no_points_at_all_have_finite_answers_and_derivatives():
    points, normals = oriented(COUNT)
    thrice = np.repeat(points[:100], 3, axis=0)
    for slope in value_and_slopes(network(), thrice, normals, np.ones(COUNT, bool))[1]:
        assert np.isfinite(slope).all()
    nothing = np.zeros(COUNT, bool)
    log_p = answer(network(), points, normals, nothing)
    assert np.exp(log_p).sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_array_equal(answer(network(), points + 7.0, normals + 2.0, nothing), log_p)
    assert not np.asarray(value_and_slopes(network(), points, normals, nothing)[1][0]).any()


def test_the_temperature_divides_the_logits():
    net = network()
    cloud = oriented(COUNT)
    warmer = eqx.tree_at(lambda n: n.temperature, net, 3.0 * net.temperature)
    expected = answer(net, *cloud) / 3.0
    expected -= np.log(np.exp(expected).sum())
    np.testing.assert_allclose(answer(warmer, *cloud), expected, atol=1e-12)


@pytest.mark.parametrize("filled", [200, 400])
def test_a_cloud_classifier_is_sampling_and_the_network_in_its_units(filled):
    """For more and for fewer points than the network gets."""
    cloud = nbv.PointCloud.from_arrays(*oriented(filled, 2.0), 430)
    fed = nbv.geometry.farthest_point_subsample(cloud, COUNT)
    expected = answer(network(), 0.5 * np.asarray(fed.points), fed.normals, fed.mask)
    np.testing.assert_allclose(call(CloudClassifier(network(), COUNT, 0.5), cloud), expected, atol=1e-12)


MOST = 320


@functools.cache
def focused():
    """An untrained network that is not undecided."""
    net = eqx.filter_jit(lambda key: InvariantClassifier(4, key, focused=True))(jax.random.key(0))
    return eqx.tree_at(lambda n: n.temperature, net, 0.02 * net.temperature)


def with_bias(net, bias):
    return eqx.tree_at(lambda n: n.focus.head[1].bias, net, net.focus.head[1].bias + bias)


def test_points_that_tell_the_class_are_rotation_invariant():
    focus = focused().focus
    points, normals = oriented(300)
    mask = jnp.arange(300) < 280
    still = np.asarray(call(focus, jnp.asarray(points), jnp.asarray(normals), mask))
    assert np.ptp(still) > 1e-3
    turn = Rotation.random(random_state=0).as_matrix()
    moved = jnp.asarray(points @ turn.T + [0.3, -0.2, 0.1]), jnp.asarray(normals @ turn.T)
    np.testing.assert_allclose(call(focus, *moved, mask)[:280], still[:280], atol=1e-9)


def test_the_network_is_fed_the_first_points_that_tell_the_class():
    """Half of the points are chosen, with the median of the odds as the bias. Then all points of a small cloud, or
    none, are chosen and padded."""
    net, unfocused = focused(), eqx.tree_at(lambda n: n.focus, focused(), None)
    points, normals = oriented(900)
    mask = RNG.random(900) < 0.8
    odds = np.asarray(call(net.focus, points, normals, mask))
    middle = float(np.median(odds[mask]))
    few = np.flatnonzero(mask)[:25]
    for bias, filled, chosen in (
        (-middle, mask, np.flatnonzero(mask & (odds > middle))[:MOST]),
        (100.0, np.isin(np.arange(900), few), few),
        (-100.0, mask, few[:0]),
    ):
        rows = np.pad(chosen, (0, MOST - len(chosen)))
        expected = answer(unfocused, points[rows], normals[rows], np.arange(MOST) < len(chosen))
        log_p, slopes = answers_and_slopes(with_bias(net, bias), points, normals, filled)
        np.testing.assert_allclose(log_p, expected, atol=1e-10)
        assert np.isfinite(slopes).all()
        assert bool(np.abs(slopes).max() > 0) == (len(chosen) > 0)


@eqx.filter_jit
def answers_and_slopes(net, points, normals, mask):
    def first(points):
        log_p = net(points, normals, mask)
        return log_p[0], log_p

    slopes, log_p = jax.grad(first, has_aux=True)(points)
    return log_p, slopes
