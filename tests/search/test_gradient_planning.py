"""Gradient searches within a planner: compilation, episodes on disk, and scores without a gradient."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from small_planner import FIRST, SCENE

import jaxnbv as nbv
from jaxnbv.planning.episode import read_views
from jaxnbv.storage import describe

KEY, SMALL = jax.random.key(0), {"num_starts": 2, "iterations": 3, "num_candidates": 4}


def planner_of(search, acquisition=nbv.Coverage()):  # noqa: B008
    sampler = nbv.SurfaceSampler(nbv.GeometricSPSR(truncation=6, lengthscale=0.05), nbv.Grid(20), num_samples=2)
    return nbv.Planner(acquisition, search, nbv.Camera(height=6, width=6), sampler, capacity=64, max_views=6)


PLANNER = planner_of(nbv.GradientSearch(dof=2, **SMALL))


def test_a_planner_compiles_the_search_once(compilations):
    """The whole search is one compiled function. A second episode with another seed and first view compiles nothing."""
    elsewhere, other_key = nbv.look_at((-0.8, 0.9, 2.2)), jax.random.key(1)
    episode = nbv.simulate(PLANNER, SCENE, FIRST, 3, KEY, progress=False)
    before = len(compilations)
    assert before > 0
    other = nbv.simulate(PLANNER, SCENE, elsewhere, 4, other_key, progress=False)
    assert len(compilations) == before
    assert not np.array_equal(episode.views[1].pose.position, other.views[1].pose.position)


def test_trajectories_come_back_from_disk_with_the_same_bits(tmp_path):
    episode = nbv.simulate(PLANNER, SCENE, FIRST, 4, KEY, folder=tmp_path / "whole", progress=False)
    views = read_views(episode.open(tmp_path / "whole"))
    assert views[0][2] is None
    for (_, _, read), view in zip(views[1:], episode.views[1:], strict=True):
        assert read.trajectories.values.shape == (2, 4)
        assert jax.tree.structure(read) == jax.tree.structure(view.proposal)
        for a, b in zip(jax.tree.leaves(read), jax.tree.leaves(view.proposal), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)

    nbv.simulate(PLANNER, SCENE, FIRST, 2, KEY, folder=tmp_path / "parts", progress=False)
    resumed = nbv.simulate(PLANNER, SCENE, FIRST, 4, KEY, folder=tmp_path / "parts", progress=False)
    for file in (tmp_path / "whole").iterdir():
        assert file.read_bytes() == (tmp_path / "parts" / file.name).read_bytes()
    for a, b in zip(jax.tree.leaves(resumed.views), jax.tree.leaves(episode.views), strict=True):
        np.testing.assert_array_equal(a, b)


def sgd(rate):
    return optx.OptaxMinimiser(optax.sgd(rate), rtol=0.0, atol=0.0)


def test_a_record_tells_settings_apart():
    for one, other in (
        (nbv.GradientSearch(dof=6), nbv.GradientSearch(space=nbv.search.FreePoses(radius=2.4))),
        (nbv.GradientSearch(solver=sgd(0.1)), nbv.GradientSearch(solver=sgd(0.2))),
    ):
        assert describe(one) != describe(other)
        assert describe(one) == describe(jax.tree.map(lambda leaf: leaf, one))


def on_host(points, normals, mask):
    return np.full((len(points), 2), np.log(0.5))


def called_back(cloud):
    result = jax.ShapeDtypeStruct((), cloud.points.dtype)
    return jax.pure_callback(lambda points: np.asarray(points).sum(), result, cloud.points, vmap_method="sequential")


@pytest.mark.parametrize(
    "score",
    [
        nbv.CrossEntropy(nbv.HostClassifier(on_host, 2)),
        nbv.ExpectedUtilityImprovement(called_back),
        nbv.ExpectedUtilityImprovement(lambda cloud: called_back(dataclasses.replace(cloud, points=cloud.normals))),
    ],
    ids=["cross-entropy", "of points", "of normals"],
)
def test_a_score_without_gradient_is_refused_at_once(score):
    with pytest.raises(ValueError, match=rf"{type(score).__name__} cannot be differentiated.*DiscreteSearch"):
        planner_of(nbv.GradientSearch(), score)
    planner_of(nbv.DiscreteSearch(), score)


def test_a_derivative_that_is_not_a_number_is_reported():
    """The square root has a finite value at zero, but no finite slope."""
    score = nbv.ExpectedUtilityImprovement(lambda cloud: jnp.sqrt(0.0 * jnp.sum(cloud.points**2)) + 1.0 * cloud.count)
    planner = planner_of(nbv.GradientSearch(**SMALL), score)
    observations = planner.init(FIRST, nbv.scan(SCENE, planner.camera, FIRST))
    with pytest.raises(ValueError, match=r"not a number.*derivatives"):
        planner.propose(observations, KEY)
