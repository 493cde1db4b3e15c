"""Acquisitions of classification against their formulas in float64 NumPy."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from opinions import context_of, drawn_cloud, linear, linear_in_numpy, nothing, score_of

import jaxnbv as nbv
from jaxnbv.tasks.classification import Classifier, cross_entropy, entropy
from jaxnbv.viz.answers import words_of

RNG = np.random.default_rng(0)
CAMERA, GRID = nbv.Camera(height=6, width=7), nbv.Grid(20)


def first_point(cloud):
    """The coordinates of D's first point are three probabilities. For a union they come from its last point."""
    return jnp.log(jnp.where(cloud.mask[-1], cloud.points[-1], cloud.points[0]))


def random_cloud(count, capacity, center=(0.0, 0.0, 0.0)):
    return drawn_cloud(RNG, count, capacity, center)


def one_point(p):
    """A cloud for which `first_point` gives the probabilities p."""
    return nbv.PointCloud.from_arrays(np.array([p]), np.array([[0.0, 0.0, 1.0]]))


def entropy_in_numpy(p, q=None):
    q = p if q is None else q
    return -sum(a * np.log(b) for a, b in zip(p, q, strict=True) if a > 0)


def test_entropies_of_batches_against_their_formulas(x64):
    p, q = RNG.dirichlet(np.ones(5), size=(2, 7, 3))
    np.testing.assert_allclose(entropy(jnp.log(p)), -(p * np.log(p)).sum(axis=-1), rtol=1e-12)
    np.testing.assert_allclose(cross_entropy(jnp.log(p), jnp.log(q)), -(p * np.log(q)).sum(axis=-1), rtol=1e-12)
    assert float(entropy(jnp.log(jnp.full(5, 0.2)))) == pytest.approx(np.log(5), rel=1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_probability_zero_has_a_finite_price(x64, dtype):
    with np.errstate(divide="ignore"):
        sure = jnp.asarray(np.log([0.0, 1.0, 0.0]), dtype)
        half = jnp.asarray(np.log([0.5, 0.5, 0.0]), dtype)
    assert float(entropy(sure)) == 0
    assert float(entropy(half)) == pytest.approx(np.log(2), rel=1e-6)
    assert float(cross_entropy(half, half)) == pytest.approx(np.log(2), rel=1e-6)
    assert float(cross_entropy(half, sure)) == pytest.approx(-0.5 * np.log(np.finfo(dtype).tiny), rel=1e-5)
    for function in (entropy, lambda log_p: cross_entropy(log_p, half), lambda log_p: cross_entropy(half, log_p)):
        for at in (sure, half):
            assert np.isfinite(jax.grad(function)(at)).all()


@pytest.mark.parametrize(
    ("p", "q"),
    [
        ([0.2, 0.3, 0.5], [0.7, 0.2, 0.1]),
        ([0.02, 0.03, 0.95], [0.4, 0.3, 0.3]),
        ([1.0, 0.0, 0.0], [0.5, 0.25, 0.25]),
        ([0.5, 0.5, 0.0], [0.75, 0.25, 0.0]),
    ],
)
def test_scores_of_chosen_probabilities(x64, p, q):
    before, after = entropy_in_numpy(p), entropy_in_numpy(q)
    reduction, crossed = max(0.0, before - after), entropy_in_numpy(p, q)
    cloud, scanned = one_point(p), one_point(q)
    scores = {
        nbv.CrossEntropy(first_point): crossed,
        nbv.tasks.MixedEntropy(first_point): crossed if before > 0.75 else reduction,
        nbv.tasks.MixedEntropy(first_point, threshold=2.0): reduction,
        nbv.tasks.MixedEntropy(first_point, threshold=0.0): crossed if before > 0 else reduction,
        nbv.tasks.EntropyReduction(first_point): reduction,
    }
    for score, expected in scores.items():
        assert float(score_of(score, context_of(score, cloud), scanned)) == pytest.approx(
            expected, rel=1e-12, abs=1e-15
        )


def test_the_switch_is_at_the_threshold_and_not_above_it(x64):
    p, q = [0.2, 0.3, 0.5], [0.1, 0.1, 0.8]
    exactly = float(entropy(first_point(one_point(p))))
    for threshold, expected in ((exactly, exactly - entropy_in_numpy(q)), (exactly - 1e-9, entropy_in_numpy(p, q))):
        score = nbv.tasks.MixedEntropy(first_point, threshold=threshold)
        assert float(score_of(score, context_of(score, one_point(p)), one_point(q))) == pytest.approx(
            expected, rel=1e-12
        )
    with pytest.raises(nbv.InputError, match=r"threshold is -0\.1"):
        nbv.tasks.MixedEntropy(first_point, threshold=-0.1)


def scores_of(**settings):
    """Scores that are the cross entropy, twice, and the reduction of entropy, twice."""
    return (
        nbv.CrossEntropy(linear, **settings),
        nbv.tasks.MixedEntropy(linear, threshold=0.0, **settings),
        nbv.tasks.MixedEntropy(linear, threshold=2.0, **settings),
        nbv.tasks.EntropyReduction(linear, **settings),
    )


def test_a_scan_that_sees_nothing_is_worth_nothing_and_has_no_gradient(x64):
    data, scan = random_cloud(20, 25), nothing(6)

    def values(points):
        seen = nbv.PointCloud(points, scan.normals, scan.mask)
        each = jnp.stack([score_of(score, context_of(score, data), seen) for score in scores_of()])
        return each, each

    slopes, each = jax.jit(jax.jacrev(values, has_aux=True))(scan.points)
    assert not np.asarray(each).any()
    assert not np.asarray(slopes).any()


def test_thinning_is_that_by_hand_and_happens_once_before_scans_are_added(x64):
    data, scanned = random_cloud(60, 80), random_cloud(15, 18, (0.3, 0.0, 0.0))
    by_hand = nbv.geometry.farthest_point_subsample(data, 16)
    p = linear_in_numpy(*by_hand.to_numpy())
    q = linear_in_numpy(*nbv.geometry.concatenate(by_hand, scanned).to_numpy())
    crossed, reduction = entropy_in_numpy(p, q), max(0.0, entropy_in_numpy(p) - entropy_in_numpy(q))
    for score, expected in zip(scores_of(num_points=16), (crossed, crossed, reduction, reduction), strict=True):
        context = context_of(score, data)
        for leaf, wanted in zip(jax.tree.leaves(context[0]), jax.tree.leaves(by_hand), strict=True):
            np.testing.assert_array_equal(leaf, wanted)
        assert float(score_of(score, context, scanned)) == pytest.approx(expected, rel=1e-10, abs=1e-14)
    assert not np.allclose(p, linear_in_numpy(*data.to_numpy()), atol=1e-3)


def test_thinning_to_the_points_of_the_utility_keeps_its_value(x64):
    """Farthest point sampling of its own result gives the same points in the same order."""
    data = random_cloud(60, 80)

    def utility(cloud):
        fed = nbv.geometry.farthest_point_subsample(cloud, 16)
        return jnp.sum(jnp.where(fed.mask, fed.points[:, 0] * jnp.arange(16), 0.0))

    whole, thinned = nbv.ExpectedUtilityImprovement(utility), nbv.ExpectedUtilityImprovement(utility, num_points=16)
    assert float(context_of(thinned, data)[1]) == float(context_of(whole, data)[1]) == float(utility(data))
    assert context_of(whole, data)[0] is data


def test_gradients_in_the_scan_against_central_differences(x64):
    data = nbv.PointCloud.from_arrays(0.01 * RNG.normal(size=(8, 3)), np.tile([0.0, 0.0, 1.0], (8, 1)), 12)
    scanned = random_cloud(9, 11, (0.8, 0.4, -0.5))

    @jax.jit
    def values(rows):
        scan = nbv.PointCloud(*rows, scanned.mask)
        return jnp.stack([score_of(score, context_of(score, data), scan) for score in scores_of(num_points=20)])

    rows = np.stack([scanned.points, scanned.normals])
    slopes = np.asarray(jax.jit(jax.jacrev(values))(rows))
    assert not slopes[:, :, 9:].any()
    assert np.abs(slopes[:, :, :9]).min(axis=2).max(axis=-1).min() > 1e-6
    for name in range(2):
        along = np.zeros(rows.shape)
        along[name] = RNG.normal(size=rows.shape[1:])
        differences = (values(rows + 1e-6 * along) - values(rows - 1e-6 * along)) / 2e-6
        np.testing.assert_allclose(np.sum(slopes * along, axis=(1, 2, 3)), differences, rtol=1e-6)


class Named(Classifier):
    classes: ClassVar = ("cup", "bowl")

    def __call__(self, cloud):
        return jnp.log(jnp.array([0.3, 0.7]))


def test_answers_name_the_classes_where_the_classifier_does():
    data = random_cloud(50, 60)
    answer = nbv.CrossEntropy(Named()).answer(data)
    assert answer.names == ("cup", "bowl")
    np.testing.assert_allclose(answer.values, [0.3, 0.7], atol=1e-6)
    assert words_of(answer).said() == "bowl 70 %, cup 30 %"
    before = eqx.tree_at(lambda a: a.values, answer, np.array([0.9, 0.1]))
    assert words_of(answer).said(before) == "bowl 70 % (was 10 %), cup 30 % (was 90 %)"
    assert words_of(answer).found == "bowl, probability 0.70"
    answer = nbv.CrossEntropy(linear, num_points=12).answer(data)
    assert answer.names[:2] == ("class 0", "class 1")
    thinned = linear_in_numpy(*nbv.geometry.farthest_point_subsample(data, 12).to_numpy())
    np.testing.assert_allclose(answer.values, thinned, atol=1e-5)


@pytest.mark.parametrize(
    ("classifier", "message"),
    [
        (lambda cloud: jnp.array([3.0, 1.0, 0.2]), "give log_softmax"),
        (lambda cloud: jnp.array([jnp.nan, 0.0]), "sum to nan"),
        (lambda cloud: jnp.zeros((1, 2)), r"shape \(1, 2\)"),
        (lambda cloud: jnp.zeros(1), r"shape \(1,\)"),
    ],
)
def test_an_impossible_log_probability_is_named_at_the_first_scan(classifier, message):
    data = random_cloud(50, 60)
    camera = nbv.Camera(height=8, width=8)
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(lengthscale=0.05, truncation=8), carving=None)
    with pytest.raises(nbv.InputError, match=message):
        nbv.Planner(nbv.CrossEntropy(classifier), nbv.DiscreteSearch(7), camera, sampler).init(None, data)
    # Without a call there is no error.
    nbv.Planner(nbv.CrossEntropy(classifier), nbv.FarthestView(7), camera, sampler).init(None, data)
