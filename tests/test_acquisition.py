"""Expected values of acquisitions against an explicit double loop over samples and poses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import balls
from opinions import WEIGHTS, Linear, linear, linear_of_batch

import jaxnbv as nbv
from jaxnbv.networks import pretrained_classifier
from jaxnbv.scanning import scan
from jaxnbv.scanning.grid import samples_at_once
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.utility import default_batch_size

CAMERA = nbv.Camera(height=6, width=7)
GRID = nbv.Grid(20)
# The last pose looks away from the object and sees nothing.
POSES = nbv.look_at(jnp.concatenate([nbv.geometry.fibonacci_sphere(6, 2.5), jnp.array([[0.0, 3.0, 0.0]])]))
POSES = eqx.tree_at(lambda pose: pose.rotation, POSES, POSES.rotation.at[-1].set(jnp.eye(3)))


@pytest.fixture(scope="module")
def surfaces():
    """Three balls away from the origin, as sampled surfaces."""
    return balls(GRID, [0.9, 0.7, 0.5], [[0.2, 0.0, 0.1], [-0.3, 0.3, 0.0], [0.0, -0.2, 0.4]])


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    return nbv.PointCloud.from_arrays(0.4 * rng.normal(size=(9, 3)), np.tile([0.0, 1.0, 0.0], (9, 1)), capacity=12)


def height(cloud):
    """A utility of either sign: the heights of the points, minus a cost for each."""
    return jnp.sum(jnp.where(cloud.mask, jnp.tanh(2 * cloud.points[:, 1] + cloud.normals[:, 2]) - 0.1, 0.0))


def height_in_numpy(points, normals):
    return np.sum(np.tanh(2 * points[:, 1].astype(np.float64) + normals[:, 2]) - 0.1)


class Toy(nbv.Acquisition):
    """Counts the rows, with the highest point of D (the context) as weight."""

    def context(self, step):
        cloud = step.observations.cloud
        return jnp.max(jnp.where(cloud.mask, cloud.points[:, 1], -jnp.inf))

    def score(self, context, view):
        return jnp.sum(jnp.where(view.scan.mask, jnp.abs(view.scan.points[:, 1] - context), 0.0))


@pytest.fixture(scope="module")
def scans(surfaces):
    """Points and normals that each pose sees of each surface."""
    each = [jax.tree.map(lambda leaf, s=s: leaf[s], surfaces) for s in range(3)]
    return [[scan(surface, CAMERA, pose).to_numpy() for pose in POSES] for surface in each]


def double_loop(scans, score):
    return np.array([[score(*one) for one in of_surface] for of_surface in scans])


def test_an_acquisition_against_the_double_loop(surfaces, scans, cloud):
    highest = cloud.to_numpy()[0][:, 1].max()
    values = double_loop(scans, lambda points, _: np.abs(points[:, 1] - highest).sum())
    expectations = nbv.expected_value(Toy(), cloud, surfaces, CAMERA, POSES)
    np.testing.assert_allclose(expectations, values.mean(axis=0), rtol=1e-4)
    assert values[:, :6].std(axis=0).min() > 0
    assert float(expectations[6]) == 0


def test_utility_improvement_against_its_formula(surfaces, scans, cloud):
    points, normals = cloud.to_numpy()
    before = height_in_numpy(points, normals)

    def improvement(new_points, new_normals):
        after = height_in_numpy(np.concatenate([points, new_points]), np.concatenate([normals, new_normals]))
        return after - before

    change = double_loop(scans, improvement)
    assert (change < -0.5).any()
    assert (change > 0.5).any()
    values = nbv.expected_value(nbv.ExpectedUtilityImprovement(height), cloud, surfaces, CAMERA, POSES)
    np.testing.assert_allclose(values, np.maximum(change, 0).mean(axis=0), rtol=1e-3, atol=1e-3)
    # Each sample is cut at zero, not their mean.
    assert np.abs(np.maximum(change, 0).mean(axis=0) - np.maximum(change.mean(axis=0), 0)).max() > 0.1
    assert bool((values >= 0).all())
    assert float(values[6]) == 0


def test_the_context_is_computed_once_a_step(surfaces, cloud):
    ran = []

    def utility(cloud):
        if cloud.capacity == 12:
            jax.debug.callback(lambda _: ran.append(1), cloud.points[0, 0])
        return height(cloud)

    nbv.expected_value(nbv.ExpectedUtilityImprovement(utility), cloud, surfaces, CAMERA, POSES).block_until_ready()
    jax.effects_barrier()
    # It runs once before that, for the check.
    assert len(ran) == 2


class Vector(Toy):
    """An acquisition with several parameters."""

    def score(self, context, view):
        value = super().score(context, view)
        return jnp.stack([value, -value])


def test_several_acquisitions_of_the_same_scans_are_each_that_of_its_own(surfaces, cloud):
    acquisitions = (Toy(), Vector(), nbv.ExpectedUtilityImprovement(height))
    values = nbv.expected_value(nbv.AcquisitionList(acquisitions), cloud, surfaces, CAMERA, POSES)
    toy, improvement = (nbv.expected_value(acquisitions[i], cloud, surfaces, CAMERA, POSES) for i in (0, 2))
    np.testing.assert_allclose(values, jnp.stack([toy, toy, -toy, improvement], axis=1), rtol=1e-6)
    assert float(jnp.ptp(toy)) > 0 < float(jnp.ptp(improvement))
    assert nbv.AcquisitionList(acquisitions).batch_size == min(acquisition.batch_size for acquisition in acquisitions)
    lacking = nbv.ExpectedUtilityImprovement(lambda cloud: jnp.nan * cloud.points.sum())
    with pytest.raises(nbv.InputError, match="it must be finite"):
        nbv.AcquisitionList((Toy(), lacking)).check(cloud)


class Highest(eqx.Module):
    """A utility that is a callable object and no function."""

    def __call__(self, cloud):
        return height(cloud)


def test_a_plain_function_is_a_utility_whose_improvement_is_sought():
    for utility in (height, Highest()):
        plain, explicit = (
            nbv.Planner(score, nbv.FarthestView(6)) for score in (utility, nbv.ExpectedUtilityImprovement(utility))
        )
        assert plain == explicit
        assert plain.acquisition.num_points is None
    assert nbv.Planner(acquisition := Toy(), nbv.FarthestView(6)).acquisition is acquisition


CLASSES = nbv.CrossEntropy(pretrained_classifier("pyramid"), num_points=64)
HEAT = nbv.ExpectedUtilityImprovement(nbv.ColdestPoint((0.0, 0.0, 1.0), workers=1))
# All but heat.
ALL = nbv.AcquisitionList(
    (
        nbv.Coverage(),
        nbv.NewSurface(0.3),
        nbv.CrossEntropy(linear, num_points=8),
        nbv.tasks.EntropyReduction(linear, num_points=8),
        nbv.tasks.MixedEntropy(linear, num_points=8),
        nbv.ExpectedUtilityImprovement(nbv.SoftPartCount(Linear(jnp.asarray(WEIGHTS.T[:, :3], jnp.float32)), 9.0)),
        nbv.ExpectedUtilityImprovement(height, num_points=8),
    )
)


def value_of(acquisition, surfaces, cloud):
    """The expected value at one pose, as a function of its position and the cloud's points."""

    def value(x, points=cloud.points):
        data = nbv.PointCloud(points, cloud.normals, cloud.mask)
        pose = nbv.look_at(jnp.stack([x, jnp.full_like(x, 0.4), jnp.full_like(x, 2.4)]))
        return nbv.expected_value(acquisition, data, surfaces, nbv.Camera(height=3, width=3), pose[None])[0]

    return value


def test_every_acquisition_has_a_gradient_under_vmap_but_heat_says_that_it_has_none(surfaces, cloud):
    """In the pose and in the cloud."""
    at = jnp.asarray([0.5, 0.2]), jnp.broadcast_to(cloud.points, (2, *cloud.points.shape))
    values, heat = (value_of(acquisition, surfaces, cloud) for acquisition in (ALL, HEAT))
    jax.make_jaxpr(jax.vmap(jax.grad(lambda *at: jnp.sum(values(*at)), (0, 1))))(*at)
    jax.make_jaxpr(jax.vmap(heat))(*at)
    for by in (0, (0, 1)):
        with pytest.raises(nbv.InputError, match="ColdestPoint has no derivative"):
            jax.make_jaxpr(jax.vmap(jax.grad(heat, by)))(*at)


@pytest.mark.slow
def test_values_and_gradients_are_the_same_under_jit_and_vmap(surfaces, cloud):
    value = value_of(ALL, surfaces, cloud)
    along = jnp.asarray(np.random.default_rng(1).normal(size=cloud.points.shape), jnp.float32) * cloud.mask[:, None]
    ends = jnp.stack([cloud.points + step * along for step in (0.0, 3e-3, -3e-3)])
    both = lambda x, points: (value(x, points), *jax.jacrev(value, (0, 1))(x, points))  # noqa: E731
    x = jnp.full(3, 0.5)
    of_pair = jax.jit(jax.vmap(both))(x, ends)
    alone = jax.jit(both)(x[0], ends[0])
    for batched, single in zip(of_pair, alone, strict=True):
        np.testing.assert_allclose(batched[0], single, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(alone[0], value(x[0], ends[0]), rtol=1e-4, atol=1e-5)
    values, _, slopes = of_pair
    assert bool(jnp.isfinite(slopes).all() & jnp.isfinite(alone[1]).all())
    assert float(jnp.abs(alone[1]).min()) > 0
    np.testing.assert_allclose(
        jnp.sum(slopes[0] * along, axis=(1, 2)), (values[1] - values[2]) / 6e-3, rtol=0.1, atol=2e-3
    )


@pytest.mark.slow
def test_heat_is_valued_under_vmap(surfaces, cloud):
    value, x = jax.jit(value_of(HEAT, surfaces, cloud)), jnp.asarray([0.5, -0.4])
    np.testing.assert_allclose(jax.vmap(value)(x), jnp.stack([value(one) for one in x]), rtol=1e-5)


def test_only_heat_is_computed_by_the_host(surfaces, cloud):
    """Its Laplacian has no implementation in JAX. Everything else stays on the device."""
    for acquisition in (ALL, CLASSES, HEAT):
        step = lambda *data, one=acquisition: nbv.expected_value(one, *data, CAMERA, POSES)  # noqa: E731
        assert ("callback" in str(jax.make_jaxpr(step)(cloud, surfaces))) == (acquisition is HEAT)


def test_samples_that_a_gpu_takes_together_have_the_same_scores(surfaces, cloud, monkeypatch):
    on_host = nbv.CrossEntropy(nbv.HostClassifier(linear_of_batch, 4))
    acquisition = nbv.AcquisitionList((nbv.Coverage(), nbv.NewSurface(), nbv.CrossEntropy(linear), on_host))
    values = lambda *data: nbv.expected_value(acquisition, *data, CAMERA, POSES)  # noqa: E731
    alone = jax.jit(values)(cloud, surfaces)
    for module in ("utility", "scanning.grid"):
        monkeypatch.setattr(f"jaxnbv.{module}.on_cpu", lambda: False)
    assert samples_at_once(CAMERA, POSES) > 3
    together = jax.jit(lambda *data: values(*data))(cloud, surfaces)
    assert float(jnp.ptp(alone, axis=0).min()) > 1e-3
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


def test_a_device_that_is_set_counts_and_not_the_one_that_was_found(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert default_batch_size() == 128
    with jax.default_device(jax.devices("cpu")[0]):
        assert default_batch_size() == 1
    with jax.default_device("cpu"):
        assert default_batch_size() == 1


@pytest.mark.parametrize(
    ("model", "search"),
    [
        (nbv.GeometricSPSR(0.1, truncation=6), nbv.DiscreteSearch(6)),
        (nbv.ScreenedSPSR(), nbv.GradientSearch(6, num_candidates=6)),
    ],
    ids=["paper-search", "screened-ascent"],
)
def test_all_products_have_full_precision_on_the_device(model, search):
    """GPUs multiply float32 matrices with 10 bits of each number by default. The host computes nothing."""
    first = nbv.look_at((0.3, 1.0, 2.3))

    def step(angle, key):
        solid = Sphere(0.5).translate((0.1, 0.0, 0.0)).rotate((1.0, 2.0, 3.0), angle)
        planner = nbv.Planner(CLASSES, search, CAMERA, nbv.SurfaceSampler(model, nbv.Grid(16), 2), capacity=64)
        observations = planner.init(first, scan(nbv.SDFSurface(solid), CAMERA, first))
        return planner.propose(planner.observe(observations, first, scan(nbv.SDFSurface(solid), CAMERA, first)), key)

    program = str(jax.make_jaxpr(step)(0.3, jax.random.key(0)))
    assert program.count("dot_general[") == program.count("precision=(Precision.HIGHEST, Precision.HIGHEST)") > 20
    assert "callback" not in program
