"""The planner: ask and tell, compilation, overflow and bad input."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_planner import CAMERA, FIRST, SCENE, planner_of

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate, farthest_point_subsample
from jaxnbv.geometry.pose import Pose, fibonacci_sphere, look_at
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import simulate
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SensorNoise, scan
from jaxnbv.search import DiscreteSearch, FarthestView
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage


@pytest.fixture(scope="module")
def planner():
    return planner_of()


@pytest.fixture(scope="module")
def observations(planner):
    return planner.init(FIRST, scan(SCENE, planner.camera, FIRST))


@pytest.mark.parametrize("search", [DiscreteSearch(12), FarthestView(12)])
def test_nothing_recompiles_after_the_second_view(search, compilations):
    planner, noise, key = planner_of(search), SensorNoise(), jax.random.key(3)
    after, observations, pose = [], None, FIRST
    observe_scene = eqx.filter_jit(lambda pose, key: noise(scan(SCENE, planner.camera, pose), key))
    for view in range(5):
        if observations is not None:
            pose = planner.propose(observations, jax.random.fold_in(key, view)).pose
        cloud = observe_scene(pose, jax.random.fold_in(key, view))
        observations = planner.init(pose, cloud) if observations is None else planner.observe(observations, pose, cloud)
        after.append(len(compilations))
    assert after[0] > 0, "the counter counts nothing"
    assert after[1:] == [after[1]] * 4, f"compilations after each view: {after}"
    jax.lax.neg(np.ones(1237 + search.uses_samples, np.float32))
    assert len(compilations) > after[-1], "the counter does not see eager operations"


def test_simulated_episodes_do_not_recompile_either(planner, compilations):
    """A whole second episode with another seed, first view and noise compiles nothing."""
    other = look_at((-0.8, 0.9, 2.2))
    simulate(planner, SCENE, FIRST, 3, jax.random.key(0), progress=False)
    before = len(compilations)
    simulate(planner, SCENE, other, 4, jax.random.key(1), progress=False)
    assert len(compilations) == before


def test_asking_and_telling_leave_the_observations_as_they_were(planner, observations):
    before = jax.tree.map(np.array, observations)
    proposal = planner.propose(observations, jax.random.key(1))
    cloud = scan(SCENE, planner.camera, proposal.pose)
    after = planner.observe(observations, proposal.pose, cloud)
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.array, observations))
    assert int(observations.num_views) == 1
    assert int(after.num_views) == 2
    np.testing.assert_array_equal(after.poses.rows.position[:2], jnp.stack([FIRST.position, proposal.pose.position]))
    assert int(after.cloud.count) == int(observations.cloud.count + cloud.count) <= 128
    with pytest.raises(AttributeError):
        observations.num_views = 3
    again = planner.propose(observations, jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(np.array, proposal), jax.tree.map(np.array, again))


def test_a_cloud_alone_makes_observations(planner):
    """A first scan from an unknown pose excludes no candidate."""
    cloud, key = scan(SCENE, planner.camera, FIRST), jax.random.key(4)
    sample_key, search_key = jax.random.split(key)
    observations = planner.init(None, cloud)
    assert int(observations.num_views) == 0
    proposal = planner.propose(observations, key)
    assert not np.isneginf(proposal.values).any()
    alone = planner.choose(planner.sampler.step_inputs(observations.cloud, sample_key), search_key)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.map(np.array, proposal), jax.tree.map(np.array, alone))


def test_beyond_its_capacity_the_cloud_is_thinned_by_farthest_points(planner, observations):
    proposal_pose = look_at((-0.8, 0.9, 2.2))
    cloud = scan(SCENE, planner.camera, proposal_pose)
    small = planner_of(capacity=40)
    first = scan(SCENE, small.camera, FIRST)
    assert int(first.count) > 40
    start = small.init(FIRST, first)
    expected = farthest_point_subsample(first, 40)
    np.testing.assert_array_equal(start.cloud.points, expected.points)
    after = small.observe(start, proposal_pose, cloud)
    expected = farthest_point_subsample(concatenate(expected, cloud), 40)
    np.testing.assert_array_equal(after.cloud.points, expected.points)
    np.testing.assert_array_equal(after.cloud.normals, expected.normals)
    assert bool(after.cloud.mask.all())


def test_a_lone_point_in_space_that_another_view_saw_empty_is_removed():
    """Thinning would keep such a point first. With a neighbour it stays, since it may be a thin part that the view
    missed."""
    camera, stray, beside = Camera(fov=1.3, height=48, width=48), np.array([0.0, 1.0, -1.0]), look_at((2.4, 0.6, -0.4))
    planner = dataclasses.replace(planner_of(capacity=400), camera=camera)
    clean, second = (scan(SCENE, camera, pose) for pose in (FIRST, beside))

    def near(observations):
        cloud, _ = observations.cloud.to_numpy()
        return int(np.sum(np.linalg.norm(cloud - stray, axis=1) < 0.2))

    for count, kept in ((1, 0), (2, 2)):
        row = np.flatnonzero(clean.missed)[:count]
        points = clean.points.at[row].set(stray + 0.1 * np.arange(count)[:, None] * [1.0, 0.0, 0.0])
        normals, mask = clean.normals.at[row].set([0.0, 0.0, 1.0]), clean.mask.at[row].set(True)
        first = planner.init(FIRST, dataclasses.replace(clean, points=points, normals=normals, mask=mask))
        assert near(first) == count
        assert near(planner.observe(first, beside, second)) == kept


def test_a_scan_that_saw_nothing_only_records_its_pose(planner, observations):
    away = Pose(np.eye(3, dtype=np.float32), np.array([0.0, 0.0, 2.5], np.float32))
    cloud = scan(SCENE, planner.camera, away)
    assert int(cloud.count) == 0
    after = planner.observe(observations, away, cloud)
    np.testing.assert_array_equal(after.cloud.points, observations.cloud.points)
    assert int(after.num_views) == 2


def cloud_at(*points):
    return PointCloud.from_arrays(list(points), [[0.0, 1.0, 0.0]] * len(points), capacity=4)


NAN = jnp.full((4, 3), jnp.nan)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (dataclasses.replace(cloud_at([0.0, 0.0, 0.1]), points=NAN), "not finite.*mask these rows"),
        (dataclasses.replace(cloud_at([0.0, 0.0, 0.1]), normals=NAN), "not finite.*mask these rows"),
        (cloud_at([0.0, 0.1, 0.0], [0.0, -40.0, 0.0]), r"coordinate of 40.*Frame\.to_scene"),
    ],
    ids=["points", "normals", "outside"],
)
def test_a_scan_with_nan_or_outside_the_scene_is_refused(planner, observations, bad, message):
    for tell in (lambda: planner.init(FIRST, bad), lambda: planner.observe(observations, FIRST, bad)):
        with pytest.raises(ValueError, match=message):
            tell()


def test_nan_in_a_masked_row_does_no_harm(planner, observations):
    cloud = cloud_at([0.0, 0.0, 0.1])
    bad = eqx.tree_at(lambda c: c.points, cloud, cloud.points.at[2].set(jnp.nan))
    after = planner.observe(observations, FIRST, bad)
    assert np.isfinite(after.cloud.points).all()
    assert int(after.cloud.count) == int(observations.cloud.count) + 1


@pytest.mark.parametrize("name", ["num_samples", "capacity", "max_views"])
def test_numbers_below_one_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} is 0"):
        planner_of(**{name: 0})


def test_a_singular_covariance_is_named():
    model = GeometricSPSR(noise=1e-5, lengthscale=0.05, truncation=8)
    points = np.linspace(0, 1e-3, 64)[:, None] * np.ones(3)
    cloud = PointCloud.from_arrays(points, np.tile([0.0, 0.0, 1.0], (64, 1)))
    sampler = SurfaceSampler(model, Grid(12), num_samples=2)
    planner = Planner(Coverage(), DiscreteSearch(4), sampler=sampler, capacity=64)
    for call in (lambda: model.condition(cloud), lambda: planner.propose(planner.init(None, cloud), jax.random.key(0))):
        with pytest.raises(ValueError, match=r"64 normals with noise=1e-05 is singular .* raise the noise"):
            call()


def test_sparse_points_warn_with_the_remedy():
    """Points farther apart than 2.5 lengthscales. One long lengthscale among several is enough."""
    points = np.asarray(fibonacci_sphere(60))
    cloud = PointCloud.from_arrays(points, points)

    def init(lengthscale, variance):
        sampler = SurfaceSampler(GeometricSPSR(lengthscale, variance, 10), Grid(16), num_samples=2)
        Planner(Coverage(), DiscreteSearch(6), CAMERA, sampler).init(None, cloud)

    with pytest.warns(UserWarning, match=r"points are 0\.4\d apart, 2\.\d times .*Scan more densely, or raise"):
        init(0.025, 0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        init((0.025, 0.06), (0.2, 0.2))


def test_parts_thinner_than_a_cell_warn_with_the_remedy():
    """Both sides of a slab were scanned. One grid is too coarse for it, and one is not."""
    x, y = (side.ravel() for side in np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 12)]))
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    sides = [PointCloud.from_arrays(np.stack([x, y, 0.04 * up[:, 2] * s], axis=1), s * up) for s in (1.0, -1.0)]

    def observe(resolution):
        sampler = SurfaceSampler(GeometricSPSR(0.05, 0.2, 10), Grid(resolution), num_samples=2)
        planner = Planner(Coverage(), DiscreteSearch(6), CAMERA, sampler, capacity=400)
        planner.observe(planner.init(None, sides[0]), look_at((0.0, 0.0, -2.5)), sides[1])

    with pytest.warns(UserWarning, match=r"288 of 288 points lie on parts thinner than a cell .*0\.0972.*Raise Grid"):
        observe(37)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        observe(60)


def test_what_is_constant_under_jit_is_checked_too(planner, observations):
    cloud = scan(SCENE, planner.camera, FIRST)
    begun = jax.jit(lambda: planner.init(FIRST, cloud))()
    np.testing.assert_array_equal(begun.cloud.points, observations.cloud.points)
    assert int(jax.jit(lambda observations: planner.observe(observations, FIRST, cloud).num_views)(observations)) == 2
    assert eqx.filter_eval_shape(planner.propose, observations, jax.random.key(0)).value.shape == ()
    long = eqx.tree_at(lambda c: c.normals, cloud, 2 * cloud.normals)
    with pytest.raises(ValueError, match="not of unit length"):
        jax.jit(lambda: planner.init(FIRST, long))()
