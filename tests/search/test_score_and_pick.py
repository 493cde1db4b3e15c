"""The two halves of a search over candidates: what it proposes is what it picks by the scores that it asks for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_discrete import CAMERA, problem, visit
from test_tie_break import Height

from jaxnbv.acquisition import Several, expected_value
from jaxnbv.scanning import GridSurface
from jaxnbv.search import (
    DiscreteSearch,
    FarthestView,
    HalvingSearch,
    RandomView,
    TieBreakSearch,
    UncertaintyView,
)
from jaxnbv.tasks import Coverage

__all__ = ["problem"]

KEY = jax.random.key(5)
SEARCHES = {
    "discrete": DiscreteSearch(12),
    "halving": HalvingSearch(12, num_first_samples=1),
    "tie-break": TieBreakSearch(12, second=Height()),
    "farthest": FarthestView(12),
    "random": RandomView(12),
    "uncertainty": UncertaintyView(12),
}
ASKED = {"discrete": (Coverage(),), "halving": (Coverage(),), "tie-break": (Coverage(), Height())}
POSES = DiscreteSearch(12).candidates.poses()


@eqx.filter_jit
def score(search, problem):
    return search.score(problem, search.candidates.poses())


@eqx.filter_jit
def pick(search, problem, scores):
    return search.pick(problem, search.candidates.poses(), scores, KEY)


@eqx.filter_jit
def propose(search, problem):
    return search.propose(problem, KEY)


@pytest.fixture(scope="module", params=[0, 2])
def asked(request, problem):
    """The problem, before any view and after some."""
    return visit(problem, POSES[3], POSES[8]) if request.param else problem


def assert_same(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    np.testing.assert_array_equal(found.pose.position, expected.pose.position)
    np.testing.assert_array_equal(found.pose.rotation, expected.pose.rotation)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", SEARCHES)
def test_what_is_picked_by_the_scores_is_what_is_proposed(name, asked):
    search = SEARCHES[name]
    assert_same(pick(search, asked, score(search, asked)), propose(search, asked))


@pytest.mark.parametrize("name", SEARCHES)
def test_scores_are_those_of_each_sample_by_each_acquisition_that_is_asked(name, problem):
    found, asked = score(SEARCHES[name], problem), ASKED.get(name, ())
    assert SEARCHES[name].asks(Coverage()) == asked
    if not asked:
        assert found.size == 0
        return
    assert found.shape == (len(asked), 3, 12)
    value = eqx.filter_jit(expected_value)
    for scores, acquisition in zip(found, asked, strict=True):
        for index, row in enumerate(scores):
            sample = jax.tree.map(lambda leaf, s=index: leaf[s : s + 1], problem.surfaces)
            expected = value(acquisition, problem.evidence.cloud, sample, CAMERA, POSES)
            np.testing.assert_allclose(row, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", [name for name, search in SEARCHES.items() if search.uses_samples])
def test_without_samples_it_says_so(name, problem):
    bare = eqx.tree_at(lambda p: p.surfaces, problem, None, is_leaf=lambda leaf: isinstance(leaf, GridSurface))
    with pytest.raises(ValueError, match="uses_samples"):
        SEARCHES[name].propose(bare, KEY)


def test_searches_share_the_scores_of_a_study(asked):
    """Those of both acquisitions, asked once, serve every search that asks for one or both."""
    both = eqx.filter_jit(lambda problem: problem.about(Several((Coverage(), Height()))).scores(POSES))(asked)
    for name, rows in {"discrete": [0], "halving": [0], "tie-break": [0, 1]}.items():
        assert_same(pick(SEARCHES[name], asked, both[jnp.asarray(rows)]), propose(SEARCHES[name], asked))
    by_height = propose(DiscreteSearch(12), eqx.filter_jit(lambda problem: problem.about(Height()))(asked))
    assert_same(pick(DiscreteSearch(12), asked, both[1:]), by_height)
    assert (by_height.pose.position != propose(DiscreteSearch(12), asked).pose.position).any()
