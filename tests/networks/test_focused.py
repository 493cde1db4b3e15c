"""The network that first finds the points that tell the class."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnbv.checks import InputError
from jaxnbv.networks import Focus, FocusedClassifier, InvariantClassifier, load_checkpoint, save_checkpoint
from jaxnbv.networks.pretrained import network_scale

RNG = np.random.default_rng(0)
FEW = 40


def network(bias=None, **settings):
    """Untrained, and not undecided; with a bias all points are chosen, or none."""
    focus, inner = Focus(jax.random.key(1)), InvariantClassifier(4, jax.random.key(0), **settings)
    inner = eqx.tree_at(lambda net: net.temperature, inner, 0.02 * inner.temperature)
    if bias is not None:
        focus = eqx.tree_at(lambda net: net.head[1].bias, focus, jnp.array([bias]))
    return FocusedClassifier(focus, inner, FEW)


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
    points, normals = (jnp.asarray(array, jnp.float32) for array in oriented(200))
    mask = jnp.asarray(RNG.random(200) < 0.8)
    odds = np.asarray(call(net.focus, points, normals, mask))
    middle = float(np.median(odds[np.asarray(mask)]))
    net = eqx.tree_at(lambda n: n.focus.head[1].bias, net, net.focus.head[1].bias - middle)
    first = np.flatnonzero(np.asarray(mask) & (odds > middle))[:FEW]
    assert len(first) == FEW
    expected = call(net.network, points[first], normals[first], jnp.ones(FEW, bool))
    np.testing.assert_allclose(call(net, points, normals, mask), expected, atol=1e-4)


@pytest.mark.parametrize(("bias", "fed"), [(100.0, 25), (-100.0, 0)])
def test_fewer_points_or_none_are_padded(bias, fed):
    net = network(bias)
    points, normals = (jnp.asarray(array, jnp.float32) for array in oriented(25))
    expected = call(net.network, points, normals, jnp.arange(25) < fed)
    np.testing.assert_allclose(call(net, points, normals), expected, atol=1e-4)
    slopes = slopes_of(net, points, normals)
    assert np.isfinite(slopes).all()
    assert bool(np.abs(slopes).max() > 0) == (fed > 0)


def test_files_hold_both_networks(tmp_path):
    net = network(classes=("a", "b", "c", "d"), groups=(30, 10), radii=(0.3, 0.9))
    save_checkpoint(net, tmp_path / "net.safetensors")
    again = load_checkpoint(tmp_path / "net.safetensors")
    assert isinstance(again, FocusedClassifier)
    assert (again.num_points, again.classes) == (FEW, ("a", "b", "c", "d"))
    assert (again.network.edge.groups, again.network.pattern.radius) == (30, 0.9)
    points, normals = (jnp.asarray(array, jnp.float32) for array in oriented(90))
    np.testing.assert_allclose(call(again, points, normals), call(net, points, normals), atol=1e-5)
    assert network_scale(again, 1.25) == 2.0


def test_a_network_that_is_fed_nothing_is_refused():
    net = network()
    with pytest.raises(InputError, match="num_points is 0"):
        FocusedClassifier(net.focus, net.network, 0)
