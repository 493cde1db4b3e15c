"""Hits in hand-made sequences, and diagnostics of a step against counts by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv import GeometricSPSR, Grid, PointCloud, as_observations
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.scanning import GridSurface
from jaxnbv.studies.classification.measures import crossed_cells, first_hits, rank_correlation, roughness, stable_hits
from jaxnbv.studies.classification.objects import PyramidStudy


def test_hits_by_view_of_hand_made_sequences():
    """One row a sequence: which views are right, and from which view on it is a first and a stable hit."""
    rows = ["00000 00000 00000", "11111 11111 11111", "01011 01111 00011", "11110 11111 00000", "00001 00001 00001"]
    words = np.array([[[letter == "1" for letter in word] for word in row.split()] for row in rows])
    correct, first, stable = words.swapaxes(0, 1)
    np.testing.assert_array_equal(first_hits(correct), first)
    np.testing.assert_array_equal(stable_hits(correct), stable)
    np.testing.assert_array_equal(stable_hits(correct[:, :1]), correct[:, :1])


def run(*guesses):
    return np.log(0.1 + 0.5 * np.eye(5)[np.array(guesses)]).tolist()


def made(method, log_p, pixels):
    noted = {"rank_correlation": [None, 0.5, None], "roughness": [None, 1.0, 3.0]}
    steps = [{"value": 2.0, "seconds": 9.0}, {"value": 1.0, "seconds": 0.3}, {"value": 1.0, "seconds": 0.1}]
    return {"scene": 0, "label": 1, "methods": {method: {"log_p": log_p, "pixels": pixels, "steps": steps, **noted}}}


def measured(record, name):
    (measure,) = (one for one in PyramidStudy.measures if one.name == name)
    (method,) = record["methods"]
    return measure.compute(record, method)


def test_measures_of_a_hand_made_record():
    """For random search they are means over its runs. The pattern is seen in a single view, not in the sum of views."""
    record = made("random", [run(0, 1, 0), run(0, 0, 1)], [[0, 149, 149], [0, 150, 0]])
    np.testing.assert_array_equal(measured(record, "first"), [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(measured(record, "stable"), [0.0, 0.0, 0.5])
    np.testing.assert_array_equal(measured(record, "seen"), [0.0, 0.5, 0.5])
    assert measured(record, "rank_correlation") == [None, 0.5, None]
    # The value of random search is no cross-entropy.
    assert measured(record, "value") == {}
    assert measured(record, "seconds") == {"median": pytest.approx(0.2)}
    for method in ("hybrid", "tie-break"):
        whole = made(method, [run(0, 1, 1)], [])
        assert measured(whole, "value") == {2: 2.0, 3: 1.0, 4: 1.0}
        assert measured(whole, "seen") == []


@pytest.mark.parametrize(("angle", "least"), [(80.0, "000"), (110.0, "110"), (139.9, "110"), (179.0, "140")])
def test_pyramids_are_told_apart_by_the_angle_of_the_first_view(angle, least):
    assert PyramidStudy.group({"angle": angle}) == f"first view at {least}° or more from the base's normal"


def test_a_plane_crosses_one_layer_of_cells():
    values = np.broadcast_to(np.linspace(-1.05, 0.95, 6)[:, None, None], (6, 6, 6))
    assert crossed_cells(values) == 25
    assert crossed_cells(np.ones((6, 6, 6))) == 0
    single = np.ones((6, 6, 6))
    single[2, 3, 3] = -1.0
    assert crossed_cells(single) == 8


def test_roughness_counts_the_samples_cells_per_cell_of_the_mean(monkeypatch):
    model, grid = GeometricSPSR(lengthscale=0.05, truncation=8), Grid(24)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cloud = PointCloud.from_arrays(directions, directions)
    sampler, observations = SurfaceSampler(model, grid=grid, carving=None), as_observations(cloud)
    posterior = model.condition(cloud)
    mean = np.asarray(posterior.mean_field.on_grid(grid.axis))
    once = GridSurface.from_values(jnp.asarray(mean), posterior.level, grid)
    assert roughness(sampler, StepInputs(observations, posterior, once)) == pytest.approx(1.0)
    # A second sample, far inside, that crosses as many cells as surround one node.
    speck = np.full_like(mean[0], 1.0)
    speck[5, 5, 5] = -1.0
    both = GridSurface.from_values(jnp.stack([mean[0] - posterior.level, jnp.asarray(speck)]), 0.0, grid)
    cells = crossed_cells(mean[0] - float(posterior.level))
    assert roughness(sampler, StepInputs(observations, posterior, both)) == pytest.approx(0.5 * (1.0 + 8.0 / cells))
    samples = posterior.sample(jax.random.key(0), 2).on_grid(grid.axis)
    drawn = GridSurface.from_values(samples, posterior.level, grid)
    assert roughness(sampler, StepInputs(observations, posterior, drawn)) > 0.8
    # Without a closed form, as for known shapes, the mean is that of the samples.
    monkeypatch.setattr(type(posterior), "has_closed_forms", False)
    halved = GridSurface.from_values(jnp.stack([jnp.asarray(mean[0]), jnp.asarray(speck)]), posterior.level, grid)
    expected = 0.5 * (cells + 8) / crossed_cells(np.asarray(halved.values).mean(axis=0))
    assert roughness(sampler, StepInputs(observations, posterior, halved)) == pytest.approx(expected)


def test_rank_correlation_is_of_the_candidates_compared():
    values, true_values = np.array([1.0, 2.0, 3.0, 9.0]), np.array([5.0, 6.0, 7.0, 0.0])
    assert rank_correlation(values, true_values, np.array([True, True, True, False])) == pytest.approx(1.0)
    # Ranks 1, 2, 3, 4 against 2, 3, 4, 1: 1 - 6 (1 + 1 + 1 + 9) / (4 (16 - 1)) = -0.2.
    assert rank_correlation(values, true_values, np.ones(4, bool)) == pytest.approx(-0.2)
    assert rank_correlation(np.ones(4), true_values, np.ones(4, bool)) is None
