"""The three baselines against slow versions of their definitions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import balls
from scipy.stats import chi2
from small_problem import propose

import jaxnbv as nbv
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.sampler import StepInputs
from jaxnbv.search.baselines import uncertain_length

GRID, LENGTH = nbv.Grid(24), eqx.filter_jit(uncertain_length)
CANDIDATES = np.asarray(nbv.geometry.fibonacci_sphere(12, 2.5), dtype=np.float64)


def problem(visited, surfaces=None):
    """Five rows for views, of which only the visited ones count. The others hold arbitrary poses."""
    positions = np.concatenate([visited, np.tile(CANDIDATES[5], (5, 1))])[:5]
    cloud = nbv.PointCloud.from_arrays([[0.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    observations = nbv.Observations(cloud, PoseList(nbv.look_at(positions), jnp.asarray(len(visited))))
    inputs = StepInputs(observations, None, surfaces)
    return nbv.search.Problem(inputs, nbv.Camera(height=4, width=4), nbv.Coverage()).prepared()


def index_of(proposal):
    return int(np.linalg.norm(CANDIDATES - np.asarray(proposal.pose.position), axis=1).argmin())


def test_farthest_view_against_its_definition():
    search, visited = nbv.FarthestView(12), [np.array([0.8, 0.9, 2.2])]
    for _ in range(4):
        proposal = propose(search, problem(np.array(visited)))
        nearest = np.array([min(np.linalg.norm(c - v) for v in visited) for c in CANDIDATES])
        new = np.array([min(np.linalg.norm(c - v) for v in visited) > 1e-3 for c in CANDIDATES])
        np.testing.assert_allclose(np.asarray(proposal.values)[new], nearest[new], rtol=1e-5)
        assert np.isneginf(np.asarray(proposal.values)[~new]).all()
        assert index_of(proposal) == nearest.argmax()
        assert float(proposal.value) == pytest.approx(nearest.max(), rel=1e-5)
        visited.append(CANDIDATES[nearest.argmax()])


def test_random_view_is_uniform_over_what_is_unvisited():
    """2,000 draws over ten candidates. The chi-square test has size 1e-4."""
    search, question = nbv.RandomView(12), problem(CANDIDATES[[3, 8]])
    draw = eqx.filter_jit(jax.vmap(lambda key: search.propose(question, key).pose.position))
    chosen = np.asarray(draw(jax.random.split(jax.random.key(0), 2000)))
    index = np.linalg.norm(CANDIDATES - chosen[:, None], axis=-1).argmin(axis=1)
    counts = np.bincount(index, minlength=12)
    assert counts[3] == counts[8] == 0
    counts = np.delete(counts, [3, 8])
    assert np.sum((counts - 200.0) ** 2 / 200.0) < chi2.ppf(1 - 1e-4, df=9)


def slow_uncertain_length(values, position, step):
    """Walk along the ray through the box, and count at every step the samples that it has not entered yet."""
    axis, h, g = GRID.axis, GRID.spacing, GRID.resolution
    forward = -position / np.linalg.norm(position)
    still_open, first, last = np.ones(len(values), bool), None, None
    for t in np.arange(0.0, 6.0, step):
        x = position + t * forward
        if np.abs(x).max() > GRID.half_extent:
            continue
        cell = np.minimum(((x - axis[0]) / h).astype(int), g - 2)
        w = (x - axis[cell]) / h
        for s in range(len(values)):
            f = 0.0
            for corner in np.ndindex(2, 2, 2):
                weight = np.prod([w[d] if corner[d] else 1 - w[d] for d in range(3)])
                f += weight * values[s][tuple(cell + corner)]
            still_open[s] &= f > 0
        transmittance = still_open.mean()
        if first is None and transmittance < 1:
            first = t
        if transmittance > 0.05:
            last = t
    return 0.0 if first is None else max(last - first, 0.0)


def test_uncertainty_against_its_definition():
    """The slow version steps by an eighth of the library's step, which finds the first end late and the last early."""
    rng = np.random.default_rng(0)
    surfaces = balls(GRID, [0.9, 0.6, 0.7, 0.3], rng.uniform(-0.5, 0.5, (4, 3)))
    search, values = nbv.search.UncertaintyView(12), np.asarray(surfaces.values, dtype=np.float64)
    question = problem(CANDIDATES[:1], surfaces)
    step = 0.5 * GRID.spacing
    expected = np.array([slow_uncertain_length(values, c, step / 8) for c in CANDIDATES])
    proposal = propose(search, question)
    short = expected - np.asarray(LENGTH(question, proposal.candidates))
    assert short.min() > -step / 4
    assert short.max() < 2 * step
    assert expected.std() > 3 * step
    np.testing.assert_array_equal(np.isneginf(proposal.values), np.arange(12) == 0)
    best = np.asarray(proposal.values).argmax()
    assert index_of(proposal) == best
    assert expected[best] > expected[1:].max() - 2.25 * step


def test_the_threshold_of_the_transmittance_by_thin_rings_of_samples():
    """One of forty samples lies far behind the rest. The ray stops counting when two are left, not none."""
    radii = np.array([1.0] * 38 + [0.3] * 2)
    value = LENGTH(problem(np.zeros((0, 3)), balls(GRID, radii)), nbv.look_at(CANDIDATES))
    np.testing.assert_allclose(value, 0.0, atol=1.1 * GRID.spacing)
    radii = np.array([1.0] * 37 + [0.3] * 3)
    value = LENGTH(problem(np.zeros((0, 3)), balls(GRID, radii)), nbv.look_at(CANDIDATES))
    np.testing.assert_allclose(value, 0.7, atol=1.1 * GRID.spacing)


def test_a_ray_that_meets_a_look_on_the_boxes_face_is_still_open():
    """The first look is exactly on the face at z = 1, where interpolation has a neighbour on one side only."""
    grid = nbv.Grid(5, 1.0)
    values = np.broadcast_to(grid.axis + 0.5, (2, 5, 5, 5)).astype(np.float32)
    values = np.stack([values[0], values[1] - 0.75])
    surfaces = nbv.scanning.GridSurface.from_values(values, 0.0, grid)
    # Surfaces are at z = -0.5 and z = 0.25, seen from z = 1.5, with looks every quarter: 1.5, 1.25, 1.0, ...
    value = LENGTH(problem(np.zeros((0, 3)), surfaces), nbv.look_at(jnp.array([[0.0, 0.0, 1.5]])))
    np.testing.assert_allclose(value, 0.75, atol=0.26)
