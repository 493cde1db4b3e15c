"""Scores of imagined surfaces against closed forms and cases worked out by hand."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from forecasts import Truth, brier, crps, empty_share, exit_depths, judge, ray_depths, reliability
from scipy.stats import norm

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere

# Nodes are 0.125 apart, and one is at the origin, so that |x| - r is interpolated exactly along the axes.
GRID = nbv.Grid(25, 1.5)
VOLUME = nbv.Box()


def test_crps_of_three_samples_by_hand():
    # mean |x - y| = (1 + 0 + 2) / 3 = 1. The pairs differ by 1, 3 and 2, by 2 on average, half of which is 1.
    assert float(crps(jnp.array([3.0, 0.0, 1.0]), jnp.array(1.0))) == pytest.approx(0.0, abs=1e-6)
    assert float(crps(jnp.array([0.0, 2.0]), jnp.array(5.0))) == pytest.approx(4.0 - 1.0)
    np.testing.assert_allclose(crps(jnp.array([[1.0, 2.0], [1.0, 2.0]]), jnp.array([1.0, 5.0])), [0.0, 3.0])
    with pytest.raises(nbv.InputError, match="CRPS of 1 samples"):
        crps(jnp.ones((1, 2)), jnp.ones(2))


@pytest.mark.parametrize("truth", [0.0, 1.3])
def test_crps_of_a_gaussian_is_unbiased_for_few_samples(truth):
    samples = np.random.default_rng(0).normal(size=(4, 40_000))
    scores = np.asarray(crps(samples, np.full(40_000, truth)))
    # Gneiting and Raftery (2007), equation 21.
    exact = truth * (2.0 * norm.cdf(truth) - 1.0) + 2.0 * norm.pdf(truth) - 1.0 / math.sqrt(math.pi)
    # Four standard errors: 0.008. The plain estimator is 1 / (4 sqrt(pi)) = 0.14 too large.
    assert scores.mean() == pytest.approx(exact, abs=4.0 * float(scores.std()) / math.sqrt(40_000))


def test_rays_leave_a_box_where_geometry_says():
    box = nbv.Box((-1.0, -1.0, -1.0), (1.0, 2.0, 1.0))
    diagonal = np.ones(3) / math.sqrt(3.0)
    origins = np.array([[0, 0, -3], [0, 0, 0], [0, 0, 0], [0, 2.5, -3], [0, 0, 3], [0.5, -4, 0.5]], float)
    directions = np.array([[0, 0, 1], diagonal, [0, 1, 0], [0, 0, 1], [0, 0, 1], [0, 1, 0]], float)
    leaves, meets = exit_depths(box, origins, directions)
    assert np.asarray(meets).tolist() == [True, True, True, False, False, True]
    np.testing.assert_allclose(np.asarray(leaves)[[0, 1, 2, 5]], [4.0, math.sqrt(3.0), 2.0, 6.0], rtol=1e-6)


def test_misses_and_hits_beyond_the_volume_have_its_far_side_as_depth():
    camera, poses = nbv.Camera(height=1, width=1), nbv.look_at(np.array([[0.0, 0.0, 2.5]] * 4))
    points = jnp.array([[[0.0, 0.0, 0.75]], [[0.0, 0.0, 0.0]], [[0.0, 0.0, -1.5]], [[0.0, 0.0, 1.5]]])
    mask = jnp.array([[True], [False], [True], [True]])
    depths, meets = ray_depths(nbv.PointCloud(points, points, mask), camera, poses, VOLUME)
    np.testing.assert_allclose(depths[:, 0], [1.75, 3.75, 3.75, 1.0], rtol=1e-6)
    assert bool(meets.all())


def test_brier_and_reliability_by_hand():
    forecast, happened = np.array([0.0, 0.25, 0.25, 1.0]), np.array([False, True, False, False])
    assert brier(forecast, happened) == pytest.approx((0.0 + 0.5625 + 0.0625 + 1.0) / 4.0)
    bins = reliability(forecast, happened)
    assert bins.nodes == [1, 0, 2, 0, 0, 0, 0, 0, 0, 1]
    assert (bins.forecast[0], bins.forecast[1], bins.forecast[2], bins.forecast[9]) == (0.0, None, 0.25, 1.0)
    assert (bins.observed[0], bins.observed[1], bins.observed[2], bins.observed[9]) == (0.0, None, 0.5, 0.0)
    with pytest.raises(nbv.InputError, match="no forecasts"):
        brier(np.zeros(0), np.zeros(0, bool))


def test_share_in_empty_space_asks_the_nearest_node():
    empty = jnp.zeros((25, 25, 25), bool).at[13:].set(True)
    points = jnp.array([[0.07, 0.0, 0.0], [0.05, 0.0, 0.0], [9.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    mask = jnp.array([True, True, True, False])
    # 0.07 is nearer to the node at 0.125, and 0.05 to the one at 0. Beyond the grid the last node is nearest.
    assert float(empty_share(points, mask, empty, GRID)) == pytest.approx(2 / 3)
    assert np.isnan(empty_share(points, mask & False, empty, GRID))


@pytest.fixture(scope="module")
def planner():
    model, camera = nbv.GeometricSPSR(lengthscale=0.3, truncation=4), nbv.Camera(height=8, width=8)
    return nbv.Planner(
        nbv.Coverage(),
        camera=camera,
        sampler=nbv.SurfaceSampler(model, grid=GRID, num_samples=2, carving=None),
        capacity=16,
    )


@pytest.fixture(scope="module")
def truth(planner):
    candidates = nbv.look_at(np.array([[2.5, 0.0, 0.0], [-2.5, 0.0, 0.0], [0.0, 2.5, 0.0]]))
    return Truth.of(nbv.SDFSurface(Sphere(1.0)), planner, candidates, VOLUME, nbv.Camera(height=1, width=1))


def _balls(*radii):
    """Balls as samples."""
    x, y, z = np.meshgrid(GRID.axis, GRID.axis, GRID.axis, indexing="ij")
    distance = np.sqrt(x**2 + y**2 + z**2)
    return nbv.scanning.GridSurface.from_values(
        jnp.stack([jnp.asarray(distance - r, jnp.float32) for r in radii]), 0.0, GRID
    )


def _state(planner):
    # One point on the right: the ball's left is farthest from it, and its right nearest.
    return planner.init(None, nbv.PointCloud.from_arrays([[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))


NOTHING = np.zeros((25, 25, 25), bool)


def test_the_true_surface_is_imagined_perfectly(planner, truth):
    record = judge(planner, _state(planner), _balls(1.0, 1.0), truth, NOTHING)
    assert record.crps == pytest.approx(0.0, abs=1e-4)
    assert record.brier == record.fair_brier == 0.0
    assert record.mean_inside == pytest.approx(record.true_inside, rel=1e-5)
    assert record.rank == pytest.approx(1.0)
    assert record.share_of_best == pytest.approx(1.0)
    assert record.in_empty == 0.0


def test_balls_of_other_sizes_are_scored_as_by_hand(planner, truth):
    record = judge(planner, _state(planner), _balls(0.5, 0.75), truth, NOTHING)
    # Errors of depth of 0.5 and 0.25, which differ by 0.25, along all three rays alike.
    assert record.crps == pytest.approx(0.375 - 0.125, abs=1e-3)
    # Nodes of the volume [-1.25, 1.25]^3 by distance: forecasts of 1, 1/2 and 0 where the truth is inside.
    axis = np.arange(-10, 11) * 0.125
    distance = np.sqrt(sum(plane**2 for plane in np.meshgrid(axis, axis, axis)))
    half, missed = ((low <= distance) & (distance < high) for low, high in ((0.5, 0.75), (0.75, 1.0)))
    assert record.brier == pytest.approx((0.25 * half.sum() + missed.sum()) / distance.size, rel=1e-5)
    assert record.fair_brier == pytest.approx(record.brier - 0.25 * half.sum() / distance.size, rel=1e-5)
    assert record.true_inside == pytest.approx((distance < 1.0).mean(), rel=1e-5)
    assert record.reliability.nodes[5] == half.sum()
    assert record.reliability.observed[5] == 1.0


def test_only_unseen_nodes_are_judged_and_hits_in_seen_space_counted(planner, truth):
    # Right of x = 0.25 everything was seen to be empty. Nothing is judged there, and one of the three rays ends there.
    is_empty = NOTHING.copy()
    is_empty[15:] = True
    record = judge(planner, _state(planner), _balls(0.5, 0.5), truth, is_empty)
    assert record.in_empty == pytest.approx(1 / 3)
    assert sum(record.reliability.nodes) == (21 - 8) * 21 * 21
    with pytest.raises(nbv.InputError, match="make both with the planner's grid"):
        judge(planner, _state(planner), _balls(0.5, 0.5), truth, is_empty[1:, 1:, 1:])


def test_a_surface_that_encloses_nothing_has_no_brier_score(planner, truth):
    sheet = Truth(truth.candidates, truth.camera, truth.volume, jnp.asarray(NOTHING), truth.depths, truth.scans)
    record = judge(planner, _state(planner), _balls(0.5, 0.75), sheet, NOTHING)
    assert record.brier is None
    assert record.reliability is None
    assert record.crps == pytest.approx(0.25, abs=1e-3)
