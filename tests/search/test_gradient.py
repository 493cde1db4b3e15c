"""Gradient searches: closed-form maxima, trajectories, empty scans, Adam by hand, degenerate starts and bad input."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from on_grid import balls, nodes
from opinions import context_of, score_of
from scipy.ndimage import gaussian_filter
from small_problem import problem_of as any_problem_of
from small_problem import propose, visit

import jaxnbv as nbv
from jaxnbv.scanning import scan

CAMERA, GRID = nbv.Camera(height=8, width=8), nbv.Grid(32)
NODES = nodes(GRID.axis)


class Nearness(nbv.Acquisition):
    """4 - |mean of the hits - target|^2. Without hits 0, the least value for targets in the unit ball."""

    target: jax.Array

    def context(self, step):
        return None

    def score(self, context, view):
        scan = view.scan
        mean = jnp.sum(jnp.where(scan.mask[:, None], scan.points, 0.0), axis=0) / jnp.maximum(scan.count, 1)
        return jnp.where(scan.count > 0, 4.0 - jnp.sum((mean - self.target) ** 2), 0.0)


def classifier(cloud):
    """Smooth log-probabilities of three classes, for any number of rows."""
    rows = jnp.concatenate([cloud.points, cloud.normals], axis=-1)
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(6, 3)), rows.dtype)
    features = jnp.where(cloud.mask[:, None], jnp.tanh(rows @ weights), 0.0)
    return jax.nn.log_softmax(3.0 * jnp.sum(features, axis=0) / jnp.maximum(cloud.count, 1))


ACQUISITIONS = (
    nbv.Coverage(),
    nbv.tasks.MixedEntropy(classifier, threshold=0.0),
    nbv.tasks.MixedEntropy(classifier, threshold=9.0),
)


def problem_of(surfaces, acquisition):
    return any_problem_of(surfaces, acquisition, CAMERA)


def rough(seed):
    """A blob off the centre whose surface is rough at the scale of two cells."""
    rng = np.random.default_rng(seed)
    noise = gaussian_filter(rng.normal(size=(2, *NODES.shape[:3])), (0, 2, 2, 2))
    away = [np.linalg.norm(NODES - rng.uniform(-0.2, 0.2, 3), axis=-1) for _ in range(2)]
    return nbv.scanning.GridSurface.from_values(np.stack(away) - 0.7 + 4.0 * noise, 0.0, GRID)


def run(name, problem, seed=0):
    return propose(SEARCHES[name], problem, jax.random.key(seed))


@eqx.filter_jit
def values_at(problem, poses):
    return problem.values(poses)


def uneven(seed):
    return problem_of(rough(seed), Nearness(jnp.asarray([0.5, -0.4, 0.6])))


def assert_equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def assert_close(a, b, atol=1e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=atol), a, b)


# The same settings wherever possible, so that tests share compiled programs.
FEW = {"num_starts": 2, "iterations": 40, "learning_rate": 0.05, "num_candidates": 6}
SEARCHES = {
    "2-DOF": nbv.GradientSearch(dof=2, **FEW),
    "BFGS": nbv.GradientSearch(dof=2, **FEW, solver=optx.BFGS(rtol=1e-4, atol=1e-4)),
    "constrained": nbv.GradientSearch(space=nbv.search.ConstrainedPoses(2.0, 3.0), **{**FEW, "learning_rate": 0.1}),
}


def mean_hit(radius, distance, gaze=0.0):
    """Distance from a ball's centre to the mean of its hits, in closed form."""
    d = np.asarray(CAMERA.pixel_directions(), np.float64)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    center = distance * np.array([np.sin(gaze), 0.0, np.cos(gaze)])
    along = d @ center
    square = along**2 - distance**2 + radius**2
    hits = (along - np.sqrt(np.maximum(square, 0.0)))[:, None] * d
    return np.linalg.norm(hits[square > 0].mean(axis=0) - center)


@pytest.mark.parametrize("name", SEARCHES)
@pytest.mark.parametrize("direction", [[0.6, 0.3, -0.74], [0.01, -1.0, 0.02]])
def test_the_known_maximum_is_found(name, direction):
    """The mean of a centred ball's hits lies before the camera, so that facing the target is best.

    With constraints it is farthest out at the least distance.
    """
    radii, distance = ((1.0, 1.0), 2.0) if name == "constrained" else ((1.0, 0.9), 2.5)
    if name == "constrained":
        ways = [mean_hit(1.0, d, gaze) for d in np.linspace(2.0, 3.0, 5) for gaze in np.radians([0.0, 3.0, 6.0, 10.0])]
        assert np.argmax(ways) == 0
    direction = np.asarray(direction) / np.linalg.norm(direction)
    maximum = 4.0 - np.mean([(mean_hit(r, distance) - 1.0) ** 2 for r in radii])

    problem = problem_of(balls(GRID, radii), Nearness(jnp.asarray(direction, jnp.float32)))
    proposal = run(name, problem, 3)
    # The trilinear ball is flatter than the true one, by 7e-4 in these values.
    assert float(proposal.value) == pytest.approx(maximum, abs=2e-3)
    assert float(proposal.value) > float(proposal.values[: SEARCHES[name].num_starts].max()) + 0.01
    position = np.asarray(proposal.pose.position, np.float64)
    # The gaze of constrained poses can compensate for a small error of the position.
    angle = 10.0 if name == "constrained" else 4.0
    assert position @ direction / np.linalg.norm(position) > np.cos(np.radians(angle))
    assert np.linalg.norm(position) == pytest.approx(distance, abs=0.15)


@pytest.mark.parametrize("name", SEARCHES)
def test_trajectories_hold_every_look_and_the_best_of_all_is_returned(name):
    """Surfaces are uneven, so that steps often lead down."""
    downhill = 0
    for seed in range(2):
        problem = uneven(seed)
        proposal = run(name, problem, seed)
        ways = proposal.trajectories
        assert ways.values.shape == (2, 41)
        assert len(proposal.values) == SEARCHES[name].num_candidates
        assert_close(ways.poses[:, 0], proposal.candidates[jnp.argsort(proposal.values, descending=True)[:2]])
        poses, values = ways.flat
        np.testing.assert_allclose(values_at(problem, poses), values, rtol=1e-4)
        # All starts take each step together.
        assert_equal(poses[2 * 17 + 1], ways.poses[1, 17])
        looks = [(proposal.candidates, proposal.values), (poses, values)]
        poses, values = jax.tree.map(lambda *rows: jnp.concatenate(rows), *looks)
        assert float(proposal.value) == float(values.max())
        assert_equal(proposal.pose, poses[int(jnp.argmax(values))])
        downhill += int((ways.values[:, -1] < ways.values.max(axis=1)).sum())
    assert downhill > 0 or name == "BFGS"


def test_visited_poses_are_neither_started_from_nor_answered():
    problem = uneven(1)
    first = run("2-DOF", problem)
    order = jnp.argsort(first.values, descending=True)
    visited = [first.pose, first.candidates[order[0]], first.candidates[order[2]]]
    again = run("2-DOF", visit(problem, *visited))
    assert_close(again.trajectories.poses[:, 0], first.candidates[order[jnp.array([1, 3])]])
    assert bool(jnp.isneginf(again.values[order[jnp.array([0, 2])]]).all())
    # The second start moves as before. Only the visited pose is excluded from it.
    third = run("2-DOF", visit(problem, again.pose))
    for pose, proposal in [(pose, again) for pose in visited] + [(again.pose, third)]:
        assert float(jnp.linalg.norm(pose.position - proposal.pose.position)) > 1e-3
    rerun = run("2-DOF", visit(problem, first.pose))
    assert float(rerun.value) < float(first.value)


def test_the_key_alone_decides():
    problem = uneven(2)
    first, again, other = (run("2-DOF", problem, seed) for seed in (1, 1, 2))
    assert_equal(first, again)
    assert float(jnp.abs(first.candidates.position - other.candidates.position).min(axis=1).max()) > 0.1


def test_a_view_of_nothing_is_worth_nothing_and_not_chosen():
    """Cameras may move and turn freely, and some starts look away from the object."""
    problem = problem_of(rough(0), nbv.Coverage())
    away = nbv.look_at(jnp.asarray([[0.0, 0.0, 2.5], [2.5, 0.0, 0.0]]), target=(0.0, 9.0, 9.0))
    towards = nbv.look_at(jnp.asarray([[1.5, -2.0, 0.3]]))
    candidates = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), away, towards)
    steps = {"num_starts": 3, "iterations": 12, "learning_rate": 0.3}
    proposal = propose(nbv.GradientSearch(dof=6, candidates=candidates, **steps), problem, jax.random.key(0))
    surface = jax.tree.map(lambda leaf: leaf[0], problem.surfaces)

    @jax.jit
    def slopes(pose):
        def scores(parameters):
            cloud = scan(surface, CAMERA, nbv.search.FreePoses().retract(pose, parameters))
            each = jnp.stack([score_of(one, context_of(one, problem.observations), cloud) for one in ACQUISITIONS])
            return each, (each, cloud.count)

        return jax.jacrev(scores, has_aux=True)(jnp.zeros(9))

    poses = jax.tree.map(lambda *rows: jnp.concatenate(rows), proposal.trajectories.flat[0], proposal.pose[None])
    slope, (each, count) = jax.lax.map(slopes, poses)
    assert bool(jnp.isfinite(slope).all() & jnp.isfinite(proposal.values).all())
    empty = np.asarray(count == 0)
    assert 24 < empty.sum() < empty.size, "some walks see the object, and some nothing"
    assert bool((each[empty] == 0).all() & (slope[empty] == 0).all() & (each >= 0).all())
    assert bool((jnp.abs(slope[~empty]).max(axis=(0, 2)) > 0).all())
    # The last pose is the one that is proposed.
    assert not empty[-1]
    assert_equal(proposal.values[:2], jnp.zeros(2))
    assert float(proposal.value) >= float(proposal.values[2]) > 0
