"""Successive halving: against rounds recomputed in NumPy from the full table of scores."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from on_grid import balls

from jaxnbv.acquisition import Acquisition, expected_value
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import fibonacci_sphere, look_at
from jaxnbv.scanning import Evidence, Grid
from jaxnbv.search import HalvingSearch, Problem

GRID, CANDIDATES, SAMPLES = Grid(16), 11, 4


class MeanHeight(Acquisition):
    """Mean of y over the scan."""

    def context(self, cloud):
        return ()

    def __call__(self, context, scan):
        return jnp.sum(scan.points[:, 1] * scan.mask) / jnp.maximum(scan.count, 1)


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(1)
    surfaces = balls(GRID, rng.uniform(0.5, 1.0, SAMPLES), rng.uniform(-0.5, 0.5, (SAMPLES, 3)))
    cloud = PointCloud.from_arrays(rng.uniform(-1, 1, (3, 3)), np.tile([0.0, 1.0, 0.0], (3, 1)))
    visited = look_at(fibonacci_sphere(CANDIDATES, 2.5)[:1])
    evidence = Evidence(cloud, visited, jnp.asarray(0))
    return Problem(evidence, Camera(height=8, width=8), MeanHeight(), surfaces).prepared()


@pytest.fixture(scope="module")
def table(problem):
    """Scores by sample and candidate."""
    poses = look_at(fibonacci_sphere(CANDIDATES, 2.5))
    each = eqx.filter_jit(expected_value)

    def of_sample(sample):
        surface = jax.tree.map(lambda leaf: leaf[sample : sample + 1], problem.surfaces)
        return each(problem.acquisition, problem.evidence.cloud, surface, problem.camera, poses)

    return np.stack([of_sample(sample) for sample in range(SAMPLES)]).astype(np.float64)


@eqx.filter_jit
def propose(search, problem):
    return search.propose(problem, jax.random.key(0))


@pytest.mark.parametrize(("num_visited", "first"), [(0, 1), (1, 1), (0, SAMPLES)])
def test_rounds_recomputed(problem, table, num_visited, first):
    problem = eqx.tree_at(lambda p: p.evidence.num_views, problem, jnp.asarray(num_visited))
    left, values, scored = np.arange(CANDIDATES), np.zeros(CANDIDATES), 0
    while scored < SAMPLES:
        if scored:
            left = left[np.argsort(-values[left], kind="stable")[: len(left) // 2]]
        scored = min(max(2 * scored, first), SAMPLES)
        values[left] = table[:scored, left].mean(axis=0)
        values[:num_visited] = -np.inf
    proposal = propose(HalvingSearch(CANDIDATES, num_first_samples=first), problem)
    best = left[np.argmax(values[left])]
    np.testing.assert_allclose(proposal.values, values, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(proposal.pose.position, fibonacci_sphere(CANDIDATES, 2.5)[best], atol=1e-6)
    assert float(proposal.value) == pytest.approx(values[best], rel=1e-4)
