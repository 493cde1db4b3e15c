"""Gradient searches within a planner: compilation, episodes on disk, scores that have no gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from small_planner import FIRST, SCENE

from jaxnbv.acquisition import ExpectedUtilityImprovement
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import look_at
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import simulate
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SensorNoise, scan
from jaxnbv.search import ConstrainedPoses, DiscreteSearch, FreePoses, GradientSearch, HybridSearch, SpherePoses
from jaxnbv.storage import EpisodeFolder, describe
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage, HostClassifier
from jaxnbv.tasks.classification import CrossEntropy

ELSEWHERE, KEY = look_at((-0.8, 0.9, 2.2)), jax.random.key(0)
OTHER_KEY = jax.random.key(1)
SMALL = {"num_starts": 2, "iterations": 3, "num_candidates": 4}


def planner_of(search, acquisition=Coverage()):  # noqa: B008
    imagination = Imagination(GeometricSPSR(truncation=6, lengthscale=0.05), Grid(20), num_samples=2)
    return Planner(acquisition, search, Camera(height=6, width=6), imagination, capacity=64, max_views=6)


PLANNER = planner_of(GradientSearch(dof=2, **SMALL))


def test_a_planner_compiles_the_search_once(compilations):
    """The whole search is one compiled function: a second episode of another seed and first view compiles nothing."""
    episode = simulate(PLANNER, SCENE, FIRST, 3, KEY, progress=False)
    before = len(compilations)
    assert before > 0
    other = simulate(PLANNER, SCENE, ELSEWHERE, 4, OTHER_KEY, progress=False)
    assert len(compilations) == before
    assert not np.array_equal(episode.views[1].pose.position, other.views[1].pose.position)


def contents(folder):
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def test_trajectories_come_back_from_disk_with_the_same_bits(tmp_path):
    episode = simulate(PLANNER, SCENE, FIRST, 4, KEY, folder=tmp_path / "whole", progress=False)
    config = describe({"planner": PLANNER, "scene": SCENE, "noise": SensorNoise(), "first": FIRST, "key": KEY})
    views = EpisodeFolder(tmp_path / "whole", config).read_views()
    assert views[0][2] is None
    for (_, _, read), view in zip(views[1:], episode.views[1:], strict=True):
        assert read.trajectories.values.shape == (2, 4)
        assert jax.tree.structure(read) == jax.tree.structure(view.proposal)
        for a, b in zip(jax.tree.leaves(read), jax.tree.leaves(view.proposal), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)

    simulate(PLANNER, SCENE, FIRST, 2, KEY, folder=tmp_path / "parts", progress=False)
    resumed = simulate(PLANNER, SCENE, FIRST, 4, KEY, folder=tmp_path / "parts", progress=False)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    for a, b in zip(jax.tree.leaves(resumed.views), jax.tree.leaves(episode.views), strict=True):
        np.testing.assert_array_equal(a, b)


def sgd(rate):
    return optx.OptaxMinimiser(optax.sgd(rate), rtol=0.0, atol=0.0)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (GradientSearch(dof=2), GradientSearch(dof=6)),
        (GradientSearch(dof=2), HybridSearch(dof=2)),
        (GradientSearch(dof=6), GradientSearch(space=FreePoses(radius=2.4))),
        (GradientSearch(), GradientSearch(num_candidates=61)),
        (GradientSearch(), GradientSearch(solver=optx.BFGS(rtol=1e-4, atol=1e-4))),
        (GradientSearch(solver=sgd(0.1)), GradientSearch(solver=sgd(0.2))),
    ],
)
def test_a_record_tells_settings_apart(one, other):
    assert describe(one) != describe(other)
    assert describe(one) == describe(jax.tree.map(lambda leaf: leaf, one))


def on_host(points, normals, mask):
    return np.full((len(points), 2), np.log(0.5))


def called_back(cloud):
    result = jax.ShapeDtypeStruct((), cloud.points.dtype)
    return jax.pure_callback(lambda points: np.asarray(points).sum(), result, cloud.points, vmap_method="sequential")


def called_back_with_normals(cloud):
    return called_back(PointCloud(cloud.normals, cloud.normals, cloud.mask))


HOST = HostClassifier(on_host, 2)


@pytest.mark.parametrize(
    "score",
    [CrossEntropy(HOST), ExpectedUtilityImprovement(called_back), ExpectedUtilityImprovement(called_back_with_normals)],
    ids=["cross-entropy", "of points", "of normals"],
)
def test_a_score_without_gradient_is_refused_at_once(score):
    with pytest.raises(ValueError, match=rf"{type(score).__name__} cannot be differentiated.*DiscreteSearch"):
        planner_of(GradientSearch(), score)
    planner_of(DiscreteSearch(), score)


@pytest.mark.parametrize(
    "space",
    [SpherePoses(), *(pytest.param(space, marks=pytest.mark.slow) for space in (FreePoses(), ConstrainedPoses()))],
)
def test_a_derivative_that_is_not_a_number_is_reported(space):
    """The square root's value at zero is finite, its slope is not."""
    score = ExpectedUtilityImprovement(lambda cloud: jnp.sqrt(0.0 * jnp.sum(cloud.points**2)) + 1.0 * cloud.count)
    planner = planner_of(GradientSearch(space=space, **SMALL), score)
    evidence = planner.init(FIRST, scan(SCENE, planner.camera, FIRST))
    with pytest.raises(ValueError, match=r"not a number.*derivatives"):
        planner.propose(evidence, KEY)
