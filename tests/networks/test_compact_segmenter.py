"""The small part segmenter: its invariances, gradients and file; the shipped weights on new objects."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_clouds import scanned_clouds

from jaxnbv.networks import CATEGORIES, CompactPartSegmenter, part_segmenter
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.studies.sensors import PART_SETTING

RNG = np.random.default_rng(0)
COUNT = 300
CHAIR, MUG = 4, 11
segment = eqx.filter_jit(lambda network, *arguments: network(*arguments))


@pytest.fixture(scope="module")
def network():
    return eqx.filter_jit(CompactPartSegmenter)(jax.random.key(0))


def cloud(count=COUNT):
    """Points on the faces of a box, with outward normals."""
    axis, sign = RNG.integers(0, 3, count), RNG.choice([-1.0, 1.0], count)
    points, normals = RNG.uniform(-0.8, 0.8, (count, 3)), np.zeros((count, 3))
    points[np.arange(count), axis] = 0.8 * sign
    normals[np.arange(count), axis] = sign
    return points.astype(jnp.result_type(float)), normals.astype(jnp.result_type(float))


def test_it_gives_log_probabilities_and_is_small(network):
    log_p = segment(network, *cloud(), CHAIR, np.ones(COUNT, bool))
    assert log_p.shape == (COUNT, 50)
    np.testing.assert_allclose(np.exp(log_p).sum(axis=1), 1.0, atol=1e-5)
    # No output of a random network is constant over the object.
    assert np.ptp(log_p, axis=0).min() > 1e-3
    assert 80_000 < sum(leaf.size for leaf in jax.tree.leaves(network)) < 130_000


def test_masked_rows_do_not_matter_whatever_they_hold_and_wherever_they_stand(network):
    points, normals = cloud()
    mask = np.arange(COUNT) < 220
    log_p = segment(network, points, normals, CHAIR, mask)
    worse = points.copy(), normals.copy()
    for rows in worse:
        rows[~mask] = np.nan
    np.testing.assert_array_equal(segment(network, *worse, CHAIR, mask)[mask], log_p[mask])
    # The first row stays, since farthest point sampling starts there. The others change places with the padding.
    order = np.concatenate([[0], 1 + RNG.permutation(COUNT - 1)])
    moved = segment(network, points[order], normals[order], CHAIR, mask[order])
    np.testing.assert_allclose(moved[mask[order]], log_p[order][mask[order]], atol=2e-4)


def test_the_category_matters_and_may_be_an_array(network):
    points, normals = cloud()
    mask = np.ones(COUNT, bool)
    chair, mug = (np.asarray(segment(network, points, normals, jnp.asarray(c), mask)) for c in (CHAIR, MUG))
    assert np.abs(chair - mug).max() > 1e-2
    np.testing.assert_allclose(segment(network, points, normals, CHAIR, mask), chair, atol=1e-5)


@eqx.filter_jit
def value_and_gradient(network, points, normals, mask, weights):
    def value(rows):
        log_p = network(*rows, CHAIR, mask)
        return jnp.sum(jnp.where(mask[:, None], weights * log_p, 0.0))

    return jax.value_and_grad(value)((points, normals))


def test_gradients_are_finite_and_those_of_finite_differences(network, x64):
    double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), network)
    points, normals = cloud()
    mask, weights = np.arange(COUNT) < 280, RNG.normal(size=(COUNT, 50))
    slopes = value_and_gradient(double, points, normals, mask, weights)[1]
    for slope in slopes:
        assert np.isfinite(slope).all()
        assert (np.asarray(slope)[~mask] == 0).all()
        assert np.abs(np.asarray(slope)[mask]).max() > 1e-2
    along, step = [RNG.normal(size=(COUNT, 3)) for _ in range(2)], 1e-7
    expected = sum(np.sum(np.asarray(slope) * d) for slope, d in zip(slopes, along, strict=True))
    high, low = (
        value_and_gradient(double, points + h * along[0], normals + h * along[1], mask, weights)[0]
        for h in (step, -step)
    )
    assert float(high - low) / (2 * step) == pytest.approx(expected, rel=1e-4)
    # Repeated rows, and a cloud of a single point.
    points[100:] = points[:1]
    for mask in (np.ones(COUNT, bool), np.arange(COUNT) < 1):
        for slope in value_and_gradient(double, points, normals, mask, weights)[1]:
            assert np.isfinite(slope).all()


@eqx.filter_jit
def predicted(segmenter, found):
    def of_cloud(example):
        own = eqx.tree_at(lambda s: s.category, segmenter, example.labels)
        return own.predict(example.clouds)

    return jax.lax.map(of_cloud, found)


@pytest.mark.slow
def test_the_shipped_weights_know_the_parts_of_objects_that_they_were_not_trained_on(computes):
    """Two test objects of each procedural category. Training uses none of them."""
    batch = scanned_clouds(part_scene, Split.TEST, range(5000, 5026), setting=PART_SETTING)
    fed, said = jax.tree.map(np.asarray, predicted(part_segmenter("chair", num_points=1024), batch))
    # Farthest point sampling of its own result returns it in the same order.
    np.testing.assert_array_equal(fed.points, batch.clouds.points)
    mask, labels = np.asarray(batch.clouds.mask), np.asarray(batch.point_labels)
    for category, rows, there in zip(np.asarray(batch.labels), said, mask, strict=True):
        assert set(rows[there].tolist()) <= set(CATEGORIES[category].labels)
        assert (rows[~there] == -1).all()
    assert np.mean(said[mask] == labels[mask]) >= 0.85
