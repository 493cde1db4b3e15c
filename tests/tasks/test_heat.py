"""The heat utility against a dense solve in NumPy, across processes, in the acquisition, and where no heat arrives."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import trimesh
from opinions import nothing

import jaxnbv as nbv
from jaxnbv.tasks.heat import body_temperature

RNG = np.random.default_rng(0)
CAMERA, GRID = nbv.Camera(height=8, width=8), nbv.Grid(24)
POLE = np.array([0.0, 0.0, 1.0])
HEAT = nbv.tasks.HeatProblem(POLE, radius=0.4, power=8.0, duration=1.0, steps=6, initial=0.5)


def sphere(count):
    directions = RNG.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def cloud_of(points, capacity=None):
    return nbv.PointCloud.from_arrays(points, np.tile(POLE, (len(points), 1)), capacity)


def utility_of(heat, reached_only=False, workers=None):
    return nbv.ColdestPoint(heat, reached_only, workers)


def least_in_numpy(points, heat):
    """The coldest point of a connected cloud by dense solves of the paper's (I - h Delta) u_{k+1} = u_k + h f."""
    # The library's Laplacian depends slightly on the order of the points, so sort them.
    points = points[np.lexsort(points.T[::-1])]
    weak, mass = robust_laplacian.point_cloud_laplacian(points, n_neighbors=30)
    delta = -np.linalg.inv(mass.toarray()) @ weak.toarray()
    step = heat.duration / heat.steps
    u = np.full(len(points), heat.initial)
    distance, rho = np.linalg.norm(points - heat.source, axis=1), np.sqrt(mass.diagonal() / np.pi)
    f = heat.power * np.minimum(1.0, np.maximum(0.0, 0.5 + (heat.radius - distance) / (2.0 * rho)))
    for _ in range(heat.steps):
        u = np.linalg.solve(np.eye(len(u)) - step * delta, u + step * f)
    return u.min()


def test_the_utility_against_a_dense_solve(x64):
    points = sphere(150)
    utility = utility_of(HEAT, workers=1)
    least = utility(cloud_of(points, 170))
    assert float(least) == pytest.approx(-least_in_numpy(points, HEAT), rel=1e-9)
    assert float(least) < -0.55
    for change in ({"power": 4.0}, {"duration": 2.0}, {"steps": 2}, {"initial": -1.0}, {"radius": 0.8}):
        other = dataclasses.replace(HEAT, **change)
        value = float(utility_of(other, workers=1)(cloud_of(points)))
        assert value == pytest.approx(-least_in_numpy(points, other), rel=1e-9)
        assert abs(value - float(least)) > 1e-3


def test_a_source_alone_is_heated_as_by_the_authors():
    heat = nbv.ColdestPoint(POLE).heat
    np.testing.assert_array_equal(heat.source, POLE)
    assert (heat.radius, heat.power, heat.duration, heat.steps, heat.initial) == (0.1, 10.0, 5.0, 20, 0.0)


@pytest.mark.slow
def test_workers_and_the_order_of_points_change_no_bit():
    points = np.stack([sphere(90) for _ in range(11)])
    clouds = nbv.PointCloud(jnp.asarray(points), jnp.asarray(points), jnp.asarray(RNG.uniform(size=(11, 90)) < 0.7))
    turned = jax.tree.map(lambda rows: rows[:, ::-1], clouds)
    # Use the shared pool of processes twice. The second call must not find it changed.
    values = [np.asarray(jax.vmap(utility_of(HEAT, workers=w))(c)) for w, c in ((1, clouds), (2, clouds), (2, turned))]
    np.testing.assert_array_equal(values[1], values[0])
    np.testing.assert_array_equal(values[2], values[0])
    one_by_one = [float(utility_of(HEAT, workers=1)(clouds[i])) for i in range(11)]
    np.testing.assert_array_equal(values[0], np.asarray(one_by_one, values[0].dtype))
    assert len(set(one_by_one)) == 11


def test_scenes_that_differ_in_the_source_share_a_compilation(compilations):
    cloud, call = cloud_of(sphere(80)), eqx.filter_jit(lambda utility, cloud: utility(cloud))
    first = call(utility_of(HEAT, workers=1), cloud)
    before = len(compilations)
    second = call(utility_of(dataclasses.replace(HEAT, source=-POLE), workers=1), cloud)
    assert len(compilations) == before
    assert float(first) != float(second)


def test_points_that_heat_does_not_reach(x64):
    near, far = sphere(60), sphere(60) + np.array([9.0, 0.0, 0.0])
    everything, reached = (utility_of(HEAT, only, workers=1) for only in (False, True))
    alone = float(everything(cloud_of(near)))
    assert alone == float(reached(cloud_of(near))) == pytest.approx(-least_in_numpy(near, HEAT), rel=1e-9)
    both = cloud_of(np.concatenate([near, far]))
    assert float(everything(both)) == -0.5
    assert float(reached(both)) == pytest.approx(alone, rel=1e-9)
    # The least possible value, u0 + T power, if there is no point for the minimum.
    assert float(everything(cloud_of(far))) == -0.5
    assert float(reached(cloud_of(far))) == -8.5
    assert float(everything(nothing(5))) == float(reached(nothing(5))) == -8.5
    single = cloud_of(POLE[None])
    # All power on the source's disc counts. The middle of the disc gets more than half.
    assert -8.5 <= float(everything(single)) < -4.5


def test_gradients_are_refused():
    utility = utility_of(HEAT, workers=1)
    cloud = cloud_of(sphere(20))
    with pytest.raises(nbv.InputError, match="ColdestPoint has no derivative"):
        jax.grad(lambda points: utility(eqx.tree_at(lambda c: c.points, cloud, points)))(cloud.points)
    with pytest.raises(nbv.InputError, match="use DiscreteSearch"):
        nbv.Planner(nbv.ExpectedUtilityImprovement(utility), nbv.GradientSearch(dof=2), CAMERA)


def test_the_coldest_point_of_a_mesh_and_of_a_scan_of_it():
    """A bar heated at one end is coldest at the other."""
    bar = trimesh.creation.box((2.5, 0.15, 0.15))
    mesh = nbv.TriangleMesh.from_arrays(np.asarray(bar.vertices), np.asarray(bar.faces))
    heat = nbv.tasks.HeatProblem([-1.25, 0.0, 0.0], radius=0.2)
    points, temperature = body_temperature(mesh, heat)
    truth = nbv.tasks.coldest_point(mesh, heat)
    assert truth.point[0] == pytest.approx(1.25)
    assert truth.temperature == temperature.values.min() > 0
    assert len(points) > 100 * len(mesh.vertices)
    cloud = cloud_of(mesh.sample_points(jax.random.key(0), 2000), 2100)
    estimate = nbv.tasks.coldest_point(cloud, heat)
    assert estimate.point[0] > 1.2
    assert estimate.temperature == pytest.approx(truth.temperature, rel=0.2)
    assert float(utility_of(heat, workers=1)(cloud)) == pytest.approx(-estimate.temperature, rel=1e-5)


def test_the_coldest_point_that_heat_reaches():
    near, far = sphere(60), sphere(60) + np.array([9.0, 0.0, 0.0])
    both = cloud_of(np.concatenate([near, far]))
    assert nbv.tasks.coldest_point(both, HEAT).temperature == 0.5
    reached = nbv.tasks.coldest_point(both, HEAT, reached_only=True)
    assert np.abs(reached.point).max() < 1.1
    assert reached.temperature > 0.55
    for body, why in ((cloud_of(far), "none of its 60 points"), (nothing(4), "it is empty")):
        with pytest.raises(nbv.InputError, match=why):
            nbv.tasks.coldest_point(body, HEAT, reached_only=True)


def test_points_that_are_not_finite_and_wrong_numbers_of_workers_are_refused():
    cloud = cloud_of(sphere(20))
    broken = eqx.tree_at(lambda c: c.points, cloud, cloud.points.at[3].set(jnp.nan))
    with pytest.raises(jax.errors.JaxRuntimeError, match="1 points are not finite"):
        jax.block_until_ready(utility_of(HEAT, workers=1)(broken))
    masked = eqx.tree_at(lambda c: c.mask, broken, cloud.mask.at[3].set(False))
    assert np.isfinite(float(utility_of(HEAT, workers=1)(masked)))
    with pytest.raises(nbv.InputError, match="workers is 0"):
        utility_of(HEAT, workers=0)
    assert utility_of(HEAT).workers >= 1
