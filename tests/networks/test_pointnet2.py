"""PointNet++ against reference outputs in the published layout, a plain NumPy network, and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import published_networks as published
import pytest
from published_networks import layers, near_sphere
from safetensors.numpy import save_file

import jaxnbv as nbv
from jaxnbv.networks import PointNet2Classifier, load_checkpoint
from jaxnbv.networks.layers import PooledMLP, SetAbstraction

RNG = np.random.default_rng(0)


@eqx.filter_jit
def call(network, *arguments):
    return network(*arguments)


def small_network(inputs=6, members=(8, 16), centers=10):
    """Two radii, then one, with few centres and groups of the given sizes."""
    first = tuple(PooledMLP(layers(RNG, inputs, 8, 9)) for _ in members)
    second = (PooledMLP(layers(RNG, 3 + 18, 10, 10, 12)),)
    return PointNet2Classifier(
        (
            SetAbstraction(first, (0.4, 0.8), members, centers),
            SetAbstraction(second, (0.9,), members[1:], 6),
        ),
        PooledMLP(layers(RNG, 3 + 12, 14, 16)),
        layers(RNG, 16, 12),
        layers(RNG, 12, 5)[0],
    )


def plain_network(state, kind, points, features):
    features = np.zeros((len(points), 0)) if features is None else features
    _, x = published.encode(state, kind, published.CLASSIFIERS[kind], points, features)
    for number in (1, 2):
        x = published.layer(state, x, f"fc{number}", f"bn{number}")
    x = published.layer(state, x, "fc3")
    return x - np.log(np.exp(x).sum())


@pytest.mark.parametrize("kind", ["ssg", "msg"])
def test_log_probabilities_are_those_of_the_reference(shared, kind):
    network = load_checkpoint(shared / "reference" / f"pointnet2_cls_{kind}.pth")
    with np.load(shared / "reference" / f"pointnet2_cls_{kind}_io.npz") as saved:
        points, expected = jnp.asarray(saved["points"]), saved["log_probs"]
    assert network.uses_normals
    assert np.ptp(expected) > 1
    log_p = eqx.filter_jit(lambda net, x: jax.lax.map(lambda row: net(row[:, :3], row[:, 3:]), x))(network, points)
    np.testing.assert_allclose(log_p, expected, atol=3e-5)


@pytest.mark.parametrize(
    ("kind", "inputs", "n", "repeated"),
    [("ssg", 3, 540, 0), ("msg", 6, 540, 100), ("ssg", 6, 60, 0), ("msg", 3, 60, 0)],
)
def test_against_a_plain_network(x64, tmp_path, kind, inputs, n, repeated):
    """Both layouts, with and without normals, and fewer points than centres, counted with or without duplicates.

    The reference then returns to the first centre, whereas farthest point sampling here goes through the duplicates.
    The maximum over a group is the same.
    """
    state = published.classifier_state(RNG, kind, inputs)
    save_file(state, tmp_path / "net.safetensors")
    network = load_checkpoint(tmp_path / "net.safetensors")
    rows = np.concatenate([np.arange(n - repeated), RNG.integers(0, n - repeated, repeated)])
    points, normals = (array[rows] for array in near_sphere(RNG, n))
    expected = plain_network(state, kind, np.asarray(points), np.asarray(normals) if inputs == 6 else None)
    np.testing.assert_allclose(call(network, points, normals), expected, atol=1e-11)


def test_masked_rows_and_capacity_do_not_matter(x64):
    network = small_network()
    slopes = jax.jit(jax.grad(lambda points, *rest: network(points, *rest)[0]))
    points, normals = near_sphere(RNG, 50)
    expected = call(network, points, normals)
    rows = np.sort(RNG.permutation(130)[:50])
    mask = np.zeros(130, bool)
    mask[rows] = True
    for filling in (0.0, 0.3, np.nan):
        wide = [np.full((130, 3), filling) for _ in range(2)]
        wide[0][rows], wide[1][rows] = points, normals
        padded = tuple(map(jnp.asarray, (*wide, mask)))
        np.testing.assert_allclose(call(network, *padded), expected, atol=1e-13)
        gradient = slopes(*padded)
        assert np.isfinite(gradient).all()
        assert not np.asarray(gradient)[~mask].any()


def test_gradients_against_central_differences(x64):
    network = small_network()
    points, normals = near_sphere(RNG, 30)
    mask = jnp.arange(30) % 7 != 3

    @jax.jit
    def value(arguments):
        return jnp.sum(jnp.arange(1.0, 6.0) * network(*arguments, mask))

    gradients = jax.jit(jax.grad(value))((points, normals))
    for which in (0, 1):
        assert np.abs(gradients[which]).max() > 0.05
        for _ in range(4):
            along = RNG.normal(size=(30, 3))
            ends = []
            for step in (1e-6, -1e-6):
                moved = [points, normals]
                moved[which] = moved[which] + step * along
                ends.append(float(value(tuple(moved))))
            assert float(jnp.sum(gradients[which] * along)) == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-6)


def test_a_cloud_with_no_filled_row_gives_finite_numbers(x64):
    points, normals = near_sphere(RNG, 20)
    network = eqx.filter_jit(small_network())
    log_p = network(points, normals, jnp.zeros(20, bool))
    np.testing.assert_allclose(log_p, network(jnp.zeros((1, 3)), jnp.zeros((1, 3))), atol=1e-13)


def test_shapes_that_are_not_one_cloud_are_refused():
    network = small_network()
    for points, normals in (((2, 9, 3), (2, 9, 3)), ((9, 3), (8, 3)), ((0, 3), (0, 3))):
        with pytest.raises((nbv.InputError, TypeError)):
            network(jnp.zeros(points), jnp.zeros(normals))
    with pytest.raises(nbv.InputError, match="n > 0"):
        network(jnp.zeros((0, 3)), jnp.zeros((0, 3)))
