"""The classifier that sees the points that tell the class alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnbv.networks import InvariantClassifier

RNG = np.random.default_rng(0)
MOST = 320


def network(bias=None):
    """Untrained, and not undecided; with a bias all points are chosen, or none."""
    net = InvariantClassifier(4, jax.random.key(0), focused=True)
    net = eqx.tree_at(lambda n: n.temperature, net, 0.02 * net.temperature)
    return net if bias is None else eqx.tree_at(lambda n: n.focus.head[1].bias, net, jnp.array([bias]))


def unfocused(net):
    return eqx.tree_at(lambda n: n.focus, net, None)


def oriented(count):
    points, normals = RNG.uniform(-1, 1, (count, 3)), RNG.normal(size=(count, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@eqx.filter_jit
def call(net, *arguments):
    return net(*arguments)


@eqx.filter_jit
def slopes_of(net, points, normals):
    return jax.grad(lambda points: net(points, normals)[0])(points)


def test_what_tells_the_class_does_not_depend_on_how_the_object_is_turned(x64):
    focus = jax.tree.map(lambda leaf: leaf.astype(np.float64), network().focus)
    points, normals = oriented(300)
    mask = jnp.arange(300) < 280
    still = np.asarray(call(focus, jnp.asarray(points), jnp.asarray(normals), mask))
    assert np.ptp(still) > 1e-3
    turn = Rotation.random(random_state=0).as_matrix()
    moved = jnp.asarray(points @ turn.T + [0.3, -0.2, 0.1]), jnp.asarray(normals @ turn.T)
    np.testing.assert_allclose(call(focus, *moved, mask)[:280], still[:280], atol=1e-9)


def test_the_network_is_fed_the_first_points_that_tell_the_class():
    """Of odds that divide the points into halves, found by moving the bias to their median."""
    net = network()
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
    net = network(bias)
    points, normals = (jnp.asarray(array, jnp.float32) for array in oriented(25))
    expected = call(unfocused(net), points, normals, jnp.arange(25) < fed)
    np.testing.assert_allclose(call(net, points, normals), expected, atol=1e-4)
    slopes = slopes_of(net, points, normals)
    assert np.isfinite(slopes).all()
    assert bool(np.abs(slopes).max() > 0) == (fed > 0)
