"""Diagnostics of a step against counts by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv import Evidence, GeometricSPSR, Grid, GridSurface, PointCloud
from jaxnbv.imagination import Imagination
from jaxnbv.studies.engine.diagnostics import crossed_cells, rank_correlation, roughness


def test_a_plane_crosses_one_layer_of_cells():
    values = np.broadcast_to(np.linspace(-1.05, 0.95, 6)[:, None, None], (6, 6, 6))
    assert crossed_cells(values) == 25
    assert crossed_cells(np.ones((6, 6, 6))) == 0
    single = np.ones((6, 6, 6))
    single[2, 3, 3] = -1.0
    assert crossed_cells(single) == 8


def test_roughness_counts_the_samples_cells_per_cell_of_the_mean():
    model, grid = GeometricSPSR(lengthscale=0.05, truncation=8), Grid(24)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cloud = PointCloud.from_arrays(directions, directions)
    imagination, evidence = Imagination(model, grid=grid, carving=None), Evidence.of(cloud)
    posterior = model.condition(cloud)
    mean = np.asarray(posterior.mean_field.on_grid(grid.axis))
    once = GridSurface.from_values(jnp.asarray(mean), posterior.level, grid)
    assert roughness(imagination, evidence, posterior, once) == pytest.approx(1.0)
    # A second sample, far inside, that crosses as many cells as one node has around it.
    speck = np.full_like(mean[0], 1.0)
    speck[5, 5, 5] = -1.0
    both = GridSurface.from_values(jnp.stack([mean[0] - posterior.level, jnp.asarray(speck)]), 0.0, grid)
    cells = crossed_cells(mean[0] - float(posterior.level))
    assert roughness(imagination, evidence, posterior, both) == pytest.approx(0.5 * (1.0 + 8.0 / cells))
    samples = posterior.sample(jax.random.key(0), 2).on_grid(grid.axis)
    assert roughness(imagination, evidence, posterior, GridSurface.from_values(samples, posterior.level, grid)) > 0.8


def test_rank_correlation_is_of_the_candidates_compared():
    values, true_values = np.array([1.0, 2.0, 3.0, 9.0]), np.array([5.0, 6.0, 7.0, 0.0])
    assert rank_correlation(values, true_values, np.array([True, True, True, False])) == pytest.approx(1.0)
    # Ranks 1, 2, 3, 4 against 2, 3, 4, 1: 1 - 6 (1 + 1 + 1 + 9) / (4 (16 - 1)) = -0.2.
    assert rank_correlation(values, true_values, np.ones(4, bool)) == pytest.approx(-0.2)
    assert rank_correlation(np.ones(4), true_values, np.ones(4, bool)) is None
