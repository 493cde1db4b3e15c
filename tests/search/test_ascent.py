"""Gradient searches on acquisitions in closed form: Adam by hand, ties, degenerate starts and bad settings."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from small_problem import problem_of, propose, visit

import jaxnbv as nbv


class Known(nbv.search.Problem):
    """An acquisition in closed form without surfaces: 5 - |position - place|^2 - |forward - gaze|^2."""

    place: jax.Array
    gaze: jax.Array

    def __init__(self, *problem_place_and_gaze):
        *problem, self.place, self.gaze = problem_place_and_gaze
        super().__init__(*problem)

    def scores(self, poses, samples=slice(None)):
        return 5.0 - jnp.sum((poses.position - self.place) ** 2 + (poses.forward - self.gaze) ** 2, axis=-1)[None]


def known(kind=Known, *poses):
    """The problem, with visited poses."""
    problem = problem_of(None)
    place, gaze = jnp.asarray((0.9, -1.1, 1.4)), jnp.asarray((-0.6, 0.0, -0.8))
    return kind(visit(problem, *poses).inputs, nbv.Camera(), nbv.Coverage(), place, gaze)


SOLVERS = {"Adam": None, "BFGS": optx.BFGS(rtol=1e-4, atol=1e-4), "NonlinearCG": optx.NonlinearCG(rtol=1e-4, atol=1e-4)}


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_pose_in_space_is_found(solver):
    steps = {"num_starts": 2, "iterations": 80, "learning_rate": 0.05, "solver": SOLVERS[solver]}
    proposal = propose(nbv.GradientSearch(dof=6, num_candidates=12, **steps), known(), jax.random.key(1))
    assert float(proposal.value) == pytest.approx(5.0, abs=1e-3)
    assert float(proposal.values.max()) < 4.9
    np.testing.assert_allclose(proposal.pose.position, [0.9, -1.1, 1.4], atol=0.03)
    np.testing.assert_allclose(proposal.pose.forward, [-0.6, 0.0, -0.8], atol=0.03)


def test_a_hybrid_search_improves_on_the_discrete_search_over_the_same_candidates():
    problem, key = known(), jax.random.key(1)
    discrete = propose(nbv.DiscreteSearch(20), problem, key)
    hybrid = propose(nbv.search.HybridSearch(dof=2, num_starts=2, iterations=4, num_candidates=20), problem, key)
    np.testing.assert_allclose(hybrid.candidates.position, discrete.candidates.position, atol=1e-5)
    np.testing.assert_allclose(hybrid.values, discrete.values, rtol=1e-4)
    assert float(hybrid.value) > float(discrete.value) + 1e-3


def test_it_starts_from_the_poses_it_is_given():
    starts = nbv.look_at(nbv.geometry.fibonacci_sphere(3, 2.2))
    proposal = propose(nbv.GradientSearch(num_starts=1, iterations=1, candidates=starts), known(), jax.random.key(0))
    np.testing.assert_array_equal(proposal.candidates.position, starts.position)


class Constant(Known):
    """Every pose has the same value."""

    def scores(self, poses, samples=slice(None)):
        return jnp.full((1, poses.position.shape[0]), 7.0)


def test_where_values_tie_the_first_candidate_wins():
    search, key = nbv.GradientSearch(num_starts=2, iterations=4, num_candidates=9), jax.random.key(0)
    proposal = propose(search, known(Constant), key)
    jax.tree.map(np.testing.assert_array_equal, proposal.pose, proposal.candidates[0])
    np.testing.assert_array_equal(proposal.values, 7.0)
    again = propose(search, known(Constant, proposal.pose), key)
    jax.tree.map(np.testing.assert_array_equal, again.pose, proposal.candidates[1])


SPACES = [nbv.search.SpherePoses(), nbv.search.FreePoses(), nbv.search.ConstrainedPoses()]


@pytest.mark.parametrize("space", SPACES)
def test_adam_is_optax_in_a_plain_loop(space, x64):
    problem, start = known(), nbv.look_at(jnp.asarray([[1.2, 1.0, 1.9]]))
    steps = {"num_starts": 1, "iterations": 10, "learning_rate": 0.05}
    ways = propose(nbv.GradientSearch(space=space, candidates=start, **steps), problem, jax.random.key(0)).trajectories
    optimiser, parameters = optax.adam(0.05), jnp.zeros(space.num_parameters)
    memory = optimiser.init(parameters)

    def loss(parameters):
        pose = space.retract(start[0], parameters)
        return -problem.values(pose[None])[0], pose

    @jax.jit
    def turn(parameters, memory):
        gradient, pose = jax.grad(loss, has_aux=True)(parameters)
        updates, memory = optimiser.update(gradient, memory)
        return pose, parameters + updates, memory

    for step in range(11):
        expected, parameters, memory = turn(parameters, memory)
        np.testing.assert_allclose(ways.poses.position[0, step], expected.position, atol=1e-6)
        np.testing.assert_allclose(ways.poses.rotation[0, step], expected.rotation, atol=1e-6)
    assert float(jnp.abs(ways.poses.position[0, -1] - start.position[0]).max()) > 0.1


@pytest.mark.parametrize("space", SPACES)
def test_a_start_at_the_origin_gives_numbers(space):
    start = nbv.Pose(np.eye(3, dtype=np.float32), np.zeros(3, np.float32))
    parameters = jnp.zeros(space.num_parameters)
    move = jax.jit(lambda p: space.retract(start, p))
    for tree in (move(parameters), jax.jit(jax.jacrev(move))(parameters)):
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))
