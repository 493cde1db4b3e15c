"""A step of each task under JAX's strict settings, which are meant for user code, equals the step without them."""

import contextlib

import jax
import numpy as np
import pytest
import small_session
from opinions import Linear, linear
from small_planner import FIRST, SCENE, planner_of

import jaxnbv as nbv

STRICT = {
    "jax_debug_nans": True,
    "jax_numpy_rank_promotion": "raise",
    "jax_numpy_dtype_promotion": "strict",
    "jax_transfer_guard": "disallow",
}
HEAT = nbv.tasks.HeatProblem((0.0, 0.0, 0.7), radius=0.4, steps=6)
PARTS = nbv.SoftPartCount(Linear(np.random.default_rng(0).normal(size=(6, 5)).astype(np.float32)), 3.0)
PLANNERS = {
    "coverage": lambda: planner_of(),
    "new surface by gradient": lambda: planner_of(
        nbv.GradientSearch(num_starts=2, iterations=2, num_candidates=4), nbv.NewSurface()
    ),
    "parts by halving": lambda: planner_of(nbv.HalvingSearch(12), nbv.ExpectedUtilityImprovement(PARTS)),
    "classification by one sample": lambda: planner_of(score=nbv.CrossEntropy(linear), num_samples=1),
    "heat by the screened model": lambda: planner_of(
        score=nbv.ExpectedUtilityImprovement(nbv.ColdestPoint(HEAT, workers=1), 64),
        model=nbv.ScreenedSPSR(nbv.GeometricSPSR(0.02, 0.2, 8)),
    ),
}


@contextlib.contextmanager
def strict():
    """For all threads, as a program sets them, because a utility on the host runs in another thread."""
    before = {name: jax.config.values[name] for name in STRICT}
    try:
        for name, value in STRICT.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def step(planner, key):
    """Two views, and the proposal of the third."""
    observations = planner.init(FIRST, nbv.scan(SCENE, planner.camera, FIRST))
    second = nbv.look_at((0.8, -0.9, 2.2))
    observations = planner.observe(observations, second, nbv.scan(SCENE, planner.camera, second))
    proposal = planner.propose(observations, key)
    planner.observe(observations, proposal.pose, nbv.scan(SCENE, planner.camera, proposal.pose))
    return np.asarray(proposal.pose.matrix), np.asarray(proposal.value)


@pytest.mark.parametrize("name", PLANNERS)
def test_a_step_of_each_task_is_the_same(name):
    key = jax.random.key(0)
    plain = step(PLANNERS[name](), key)
    with strict():
        result = step(PLANNERS[name](), key)
    for one, other in zip(result, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_so_is_a_session_from_its_first_image_to_its_points():
    def matrix_and_points():
        session = small_session.begun()
        return session.next().matrix, session.cloud.to_numpy()[0]

    plain = matrix_and_points()
    with strict():
        result = matrix_and_points()
    for one, other in zip(result, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_so_is_a_simulated_episode():
    key = jax.random.key(0)
    with strict():
        episode = nbv.simulate(PLANNERS["coverage"](), SCENE, nbv.look_at((0.8, 0.9, 2.2)), 2, key, progress=False)
    plain = nbv.simulate(PLANNERS["coverage"](), SCENE, FIRST, 2, key, progress=False)
    np.testing.assert_array_equal(episode.cloud.to_numpy(), plain.cloud.to_numpy())


def test_surfaces_and_what_is_known_of_them():
    cloud, points = nbv.scan(SCENE, PLANNERS["coverage"]().camera, FIRST), np.zeros((2, 3), np.float32)
    sampler, key = PLANNERS["coverage"]().sampler, jax.random.key(0)

    def values():
        posterior = sampler.posterior(cloud)
        return posterior.mean(points), posterior.variance(points), posterior.sample(key, 2)(points)

    with strict():
        result = values()
    for one, other in zip(result, values(), strict=True):
        np.testing.assert_array_equal(one, other)
