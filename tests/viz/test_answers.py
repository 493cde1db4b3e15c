"""Words for goals and answers, for a user's own acquisitions and utilities and for shipped ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.viz.answers import label_of, words_of

POINTS = np.array([[0.0, 0.3, 0.0], [0.1, 0.8, 0.0], [0.0, -0.2, 0.4]])
CLOUD = nbv.PointCloud.from_arrays(POINTS, np.eye(3), 5)


def greatest_height(cloud):
    return jnp.max(jnp.where(cloud.mask, cloud.points[:, 1], -jnp.inf))


class Metres(nbv.Utility):
    """A utility with its own words."""

    improvement = nbv.Quantity("expected growth", "metres", "how much higher.")

    def __call__(self, cloud):
        return 2.0 * greatest_height(cloud)

    def answer(self, cloud):
        return nbv.Answer(("height", "points"), np.array([float(self(cloud)), float(cloud.count)]), "{:.1f}")


class Unnamed(nbv.Acquisition):
    def context(self, step):
        return None

    def score(self, context, view):
        return jnp.sum(view.scan.mask)


def test_a_function_has_its_name_and_value():
    acquisition = nbv.ExpectedUtilityImprovement(greatest_height)
    assert label_of(acquisition.quantity) == "expected improvement of greatest height"
    first = nbv.PointCloud.from_arrays(POINTS[:1], np.eye(3)[:1], 5)
    answer, before = acquisition.answer(CLOUD), acquisition.answer(first)
    assert words_of(answer).said(before) == "greatest height 0.8 (was 0.3)"
    assert words_of(answer).said() == words_of(answer).found == "greatest height 0.8"
    assert nbv.ExpectedUtilityImprovement(lambda cloud: 1.0).quantity.name == "expected utility improvement"


def test_a_utility_says_what_it_likes():
    acquisition = nbv.ExpectedUtilityImprovement(Metres(), num_points=1)
    assert label_of(acquisition.quantity) == "expected growth (metres)"
    # The answer uses all of D, however few points the acquisition uses.
    assert words_of(acquisition.answer(CLOUD)).said() == "height 1.6, points 3.0"
    assert nbv.DiscreteSearch().quantity(acquisition) == acquisition.quantity


def test_an_acquisition_without_words_has_its_type():
    assert Unnamed().quantity.name == "acquisition, Unnamed"
    assert Unnamed().answer(CLOUD) is None
    assert nbv.Coverage().answer(CLOUD) is None
    assert nbv.Coverage().quantity.unit_in(nbv.Frame()) == "scene units²"


def test_a_search_that_does_not_ask_the_score_says_so():
    length, kinds = "scene units", (nbv.FarthestView, nbv.RandomView, nbv.search.UncertaintyView)
    for kind, unit in zip(kinds, (length, "uniform on [0, 1)", length), strict=True):
        assert kind().quantity(nbv.Coverage()).unit_in(nbv.Frame()) == unit
        assert kind().quantity(Unnamed()) == kind().quantity(nbv.Coverage())
    assert not nbv.RandomView().quantity(Unnamed()).smooth


@pytest.mark.parametrize(
    ("utility", "message"),
    [
        (lambda cloud: cloud.points[:, 1], r"shape \(5,\) and type float32: a utility is one number"),
        (lambda cloud: jnp.log(-1.0 - jnp.sum(cloud.mask)), "a cloud of 3 points is nan: it must be finite"),
        (lambda cloud: 1.0 / jnp.sum(~cloud.mask[:3]), "must be finite"),
    ],
)
def test_an_impossible_utility_is_named_at_the_first_scan(utility, message):
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, truncation=8))
    with pytest.raises(nbv.InputError, match=message):
        nbv.Planner(utility, nbv.DiscreteSearch(4), sampler=sampler, capacity=5).init(None, CLOUD)


def test_under_jit_nothing_is_asked():
    acquisition = nbv.ExpectedUtilityImprovement(lambda cloud: jnp.nan * jnp.sum(cloud.mask))
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, truncation=8), carving=None)
    planner = nbv.Planner(acquisition, nbv.DiscreteSearch(4), sampler=sampler, capacity=5)
    assert jax.eval_shape(lambda cloud: planner.init(None, cloud), CLOUD).cloud.capacity == 5
