"""Classifiers and segmenters on the host, against the same in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from opinions import Linear, context_of, drawn_cloud, linear, linear_of_batch, score_of

import jaxnbv as nbv

RNG = np.random.default_rng(0)
CAMERA, PARTS = nbv.Camera(height=6, width=7), 5


def random_cloud(count, capacity):
    return drawn_cloud(RNG, count, capacity)


class Host:
    """`linear` in NumPy for batches. It counts its calls."""

    def __init__(self):
        self.shapes = []

    def __call__(self, points, normals, mask):
        assert all(isinstance(array, np.ndarray) for array in (points, normals, mask))
        self.shapes.append(mask.shape)
        return linear_of_batch(points, normals, mask)


def test_a_host_classifier_equals_the_one_in_jax_in_one_call_a_batch():
    clouds = [random_cloud(10 + i, 20) for i in range(6)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)
    expected = np.stack([linear(cloud) for cloud in clouds])
    calls = {
        "one": (lambda f: f(clouds[0]), [(1, 20)], expected[0]),
        "map in batches": (lambda f: jax.lax.map(f, batch, batch_size=4), [(4, 20), (2, 20)], expected),
        "vmap of vmap": (
            lambda f: jax.vmap(jax.vmap(f))(jax.tree.map(lambda a: a.reshape(2, 3, *a.shape[1:]), batch)),
            [(6, 20)],
            expected.reshape(2, 3, 4),
        ),
    }
    for name, (call, shapes, wanted) in calls.items():
        host = Host()
        values = np.asarray(call(nbv.HostClassifier(host, 4)))
        assert host.shapes == shapes, name
        np.testing.assert_allclose(values, wanted, atol=2e-5, err_msg=name)


def test_a_host_classifier_of_a_large_batch_comes_back():
    """On few cores, callbacks of JAX have waited forever for their own arguments."""
    cloud = nbv.PointCloud(jnp.ones((120, 3500, 3)), jnp.ones((120, 3500, 3)), jnp.ones((120, 3500), bool))
    host = nbv.HostClassifier(lambda points, normals, mask: np.log([0.25, 0.75]) * points[:, :2, 0] * mask[:, :2], 2)
    expected = np.tile(np.log([0.25, 0.75]), (120, 1))
    np.testing.assert_allclose(jax.jit(jax.vmap(host))(cloud), expected, rtol=1e-6)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit])
def test_a_host_classifier_that_returns_another_shape_says_so(wrap):
    host = nbv.HostClassifier(lambda points, normals, mask: np.zeros(4), 4)
    with pytest.raises((RuntimeError, nbv.InputError), match=r"HostClassifier returned shape \(4,\), not \(1, 4\)"):
        jax.block_until_ready(wrap(host)(random_cloud(5, 5)))


def test_a_host_classifier_has_no_gradient():
    score, data, scanned = nbv.CrossEntropy(nbv.HostClassifier(Host(), 4)), random_cloud(5, 5), random_cloud(4, 6)
    with pytest.raises(nbv.InputError, match="use DiscreteSearch"):
        jax.grad(
            lambda points: score_of(
                score, context_of(score, data), nbv.PointCloud(points, scanned.normals, scanned.mask)
            )
        )(scanned.points)
    with pytest.raises(nbv.InputError, match="num_classes is 1"):
        nbv.HostClassifier(Host(), 1)


def in_numpy(weight, calls):
    """`Linear` on the host, which returns values for masked rows too."""

    def function(points, normals, mask):
        calls.append(len(mask))
        e = np.exp(np.concatenate([points, normals], axis=-1) @ weight)
        return e / e.sum(axis=-1, keepdims=True)

    return function


def test_a_segmenter_on_the_host_is_one_in_jax():
    weight, calls = 2.0 * RNG.standard_normal((6, PARTS)), []
    own, host = Linear(jnp.asarray(weight, jnp.float32)), nbv.HostSegmenter(in_numpy(weight, calls), PARTS)
    cloud = random_cloud(17, 25)
    np.testing.assert_allclose(host(cloud), own(cloud), atol=1e-6)
    scores = [nbv.ExpectedUtilityImprovement(nbv.SoftPartCount(segmenter, 3.0)) for segmenter in (own, host)]
    scans = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[random_cloud(4, 6) for _ in range(5)])
    contexts = [context_of(score, cloud) for score in scores]
    del calls[:]
    values = [jax.vmap(lambda one, s=s, c=c: score_of(s, c, one))(scans) for s, c in zip(scores, contexts, strict=True)]
    np.testing.assert_allclose(values[1], values[0], atol=1e-5)
    assert calls == [5], "all candidates in one call"
    assert scores[1].batch_size == 128


def test_a_segmenter_on_the_host_has_no_derivative():
    host, cloud = nbv.HostSegmenter(in_numpy(np.ones((6, PARTS)), []), PARTS), random_cloud(4, 6)
    with pytest.raises(nbv.InputError, match="HostSegmenter has no derivative"):
        jax.grad(lambda points: jnp.sum(host(nbv.PointCloud(points, cloud.normals, cloud.mask))))(cloud.points)
    with pytest.raises(nbv.InputError, match="num_parts is 0"):
        nbv.HostSegmenter(in_numpy, 0)
