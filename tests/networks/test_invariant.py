"""The invariant network, and the one that sees only the points that tell the class: their invariances and
derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.networks import CloudClassifier, InvariantClassifier

RNG = np.random.default_rng(0)
# Points of most clouds, which then share one program.
COUNT = 300


def network():
    """An untrained network whose outputs differ between clouds by some tenths."""
    net = InvariantClassifier(5, jax.random.key(0))
    return eqx.tree_at(lambda n: n.temperature, net, net.temperature * 0.02)


def oriented(count, extent=1.0):
    points, normals = extent * RNG.uniform(-1, 1, (count, 3)), RNG.normal(size=(count, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@eqx.filter_jit
def call(net, *arguments):
    return net(*arguments)


def answer(net, points, normals, mask=None):
    mask = None if mask is None else jnp.asarray(mask)
    return np.asarray(call(net, jnp.asarray(points), jnp.asarray(normals), mask))


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 2e-2)])
def test_rotations_and_translations_do_not_matter(x64, dtype, tolerance):
    """The choice of rows by distances is invariant too, because random points have no ties that rounding could
    break."""
    net = jax.tree.map(lambda leaf: leaf.astype(dtype), network())
    points, normals = oriented(COUNT)
    still = answer(net, points.astype(dtype), normals.astype(dtype))
    assert still.dtype == dtype
    for seed in range(5):
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


def test_masked_rows_and_the_capacity_do_not_matter(x64):
    """Masked rows may be anywhere and hold anything, as long as the filled rows keep their order."""
    net, count = network(), 40
    points, normals = oriented(count)
    still = answer(net, points, normals)
    np.testing.assert_allclose(answer(net, points, normals, np.ones(count, bool)), still, atol=1e-12)
    for capacity in (count + 1, COUNT):
        rows = np.sort(RNG.choice(capacity, count, replace=False))
        for junk in (0.0, 1e6, np.nan):
            padded = [np.full((capacity, 3), junk) for _ in range(2)]
            padded[0][rows], padded[1][rows] = points, normals
            np.testing.assert_allclose(answer(net, *padded, np.isin(np.arange(capacity), rows)), still, atol=1e-12)


def test_the_order_of_rows_after_the_first_does_not_matter_where_no_ball_is_overfull(x64):
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
def test_gradients_against_central_differences(x64, count):
    """Normals are rotated, not stretched. Points alone in their balls all tie, with equal slopes for unit normals."""
    net = network()
    points, normals = (jnp.asarray(a) for a in oriented(count))

    @jax.jit
    def first(points, normals):
        return net(points, normals)[1]

    gradients = jax.jit(jax.grad(first, argnums=(0, 1)))(points, normals)
    for argument, gradient in enumerate(gradients):
        assert np.abs(gradient).max() > 1e-3
        for _ in range(4):
            along = jnp.asarray(RNG.normal(size=(count, 3)))
            if argument == 1:
                along = along - jnp.sum(along * normals, axis=1, keepdims=True) * normals
            step = [jnp.zeros_like(along)] * 2
            step[argument] = 1e-7 * along
            difference = first(points + step[0], normals + step[1]) - first(points - step[0], normals - step[1])
            assert float(jnp.sum(gradient * along)) == pytest.approx(float(difference) / 2e-7, rel=1e-5, abs=1e-7)


def test_gradients_of_duplicates_and_masked_rows_are_finite():
    net = network()
    points = jnp.asarray(np.repeat(oriented(20)[0], 3, axis=0), jnp.float32)
    normals = jnp.asarray(oriented(60)[1], jnp.float32)
    mask = jnp.arange(60) < 45
    gradients = jax.jit(jax.grad(lambda p, n: net(p, n, mask)[0], argnums=(0, 1)))(points, normals)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert not np.asarray(gradient)[45:].any()


def test_no_points_at_all_give_finite_answers_and_derivatives():
    net = network()
    empty = jnp.zeros((50, 3)), jnp.zeros((50, 3)), jnp.zeros(50, bool)
    log_p = answer(net, *empty)
    assert np.exp(log_p).sum() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_array_equal(answer(net, empty[0] + 7.0, empty[1] + 2.0, empty[2]), log_p)
    assert not np.asarray(jax.jit(jax.grad(lambda points: net(points, *empty[1:])[0]))(empty[0])).any()


def test_the_temperature_divides_the_logits(x64):
    net = network()
    cloud = oriented(COUNT)
    warmer = eqx.tree_at(lambda n: n.temperature, net, 3.0 * net.temperature)
    expected = answer(net, *cloud) / 3.0
    expected -= np.log(np.exp(expected).sum())
    np.testing.assert_allclose(answer(warmer, *cloud), expected, atol=1e-12)


def test_a_cloud_classifier_is_sampling_and_the_network_in_its_units(x64):
    net = network()
    points, normals = oriented(200, 2.0)
    cloud = nbv.PointCloud.from_arrays(points, normals, 230)
    for num_points, scale in ((64, 0.5), (300, 1.0)):
        fed = nbv.geometry.farthest_point_subsample(cloud, num_points)
        expected = answer(net, scale * np.asarray(fed.points), fed.normals, fed.mask)
        np.testing.assert_allclose(CloudClassifier(net, num_points, scale)(cloud), expected, atol=1e-12)
    halved = nbv.PointCloud.from_arrays(0.5 * points, normals, 230)
    np.testing.assert_allclose(CloudClassifier(net, 64, 2.0)(halved), CloudClassifier(net, 64, 1.0)(cloud), atol=1e-12)


MOST = 320


def focused(bias=None):
    """An untrained network that is not undecided. With a bias it chooses all points, or none."""
    net = InvariantClassifier(4, jax.random.key(0), focused=True)
    net = eqx.tree_at(lambda n: n.temperature, net, 0.02 * net.temperature)
    return net if bias is None else eqx.tree_at(lambda n: n.focus.head[1].bias, net, jnp.array([bias]))


def unfocused(net):
    return eqx.tree_at(lambda n: n.focus, net, None)


@eqx.filter_jit
def slopes_of(net, points, normals):
    return jax.grad(lambda points: net(points, normals)[0])(points)


def test_points_that_tell_the_class_are_rotation_invariant(x64):
    focus = jax.tree.map(lambda leaf: leaf.astype(np.float64), focused().focus)
    points, normals = oriented(300)
    mask = jnp.arange(300) < 280
    still = np.asarray(call(focus, jnp.asarray(points), jnp.asarray(normals), mask))
    assert np.ptp(still) > 1e-3
    turn = Rotation.random(random_state=0).as_matrix()
    moved = jnp.asarray(points @ turn.T + [0.3, -0.2, 0.1]), jnp.asarray(normals @ turn.T)
    np.testing.assert_allclose(call(focus, *moved, mask)[:280], still[:280], atol=1e-9)


def test_the_network_is_fed_the_first_points_that_tell_the_class():
    """The bias is moved to the median of the odds, so that half of the points are chosen."""
    net = focused()
    points, normals = (jnp.asarray(array, jnp.float32) for array in oriented(900))
    mask = jnp.asarray(RNG.random(900) < 0.8)
    odds = np.asarray(call(net.focus, points, normals, mask))
    middle = float(np.median(odds[np.asarray(mask)]))
    net = eqx.tree_at(lambda n: n.focus.head[1].bias, net, net.focus.head[1].bias - middle)
    first = np.flatnonzero(np.asarray(mask) & (odds > middle))[:MOST]
    assert len(first) == MOST
    expected = call(unfocused(net), points[first], normals[first], jnp.ones(MOST, bool))
    np.testing.assert_allclose(call(net, points, normals, mask), expected, atol=1e-4)


@pytest.mark.parametrize(("bias", "fed"), [(100.0, 25), (-100.0, 0)])
def test_fewer_points_or_none_are_padded(bias, fed):
    net = focused(bias)
    points, normals = (jnp.asarray(array, jnp.float32) for array in oriented(25))
    expected = call(unfocused(net), points, normals, jnp.arange(25) < fed)
    np.testing.assert_allclose(call(net, points, normals), expected, atol=1e-4)
    slopes = slopes_of(net, points, normals)
    assert np.isfinite(slopes).all()
    assert bool(np.abs(slopes).max() > 0) == (fed > 0)
