"""The soft part count against its formula in NumPy, central differences, and its limits."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from opinions import Linear, drawn_cloud, nothing

import jaxnbv as nbv
from jaxnbv.tasks import part_counts
from jaxnbv.viz.answers import words_of

RNG = np.random.default_rng(0)
PARTS = 5


def make_cloud(filled, capacity):
    return drawn_cloud(RNG, filled, capacity)


def by_hand(cloud, weight, target):
    """The count point by point and part by part."""
    total = np.zeros(weight.shape[1])
    for point, normal in zip(*cloud.to_numpy(), strict=True):
        e = np.exp(np.concatenate([point, normal]).astype(np.float64) @ weight)
        total += e / e.sum()
    return sum(np.tanh(soft / target) for soft in total)


@pytest.mark.parametrize("target", [0.5, 4.0, 60.0])
def test_the_formula_with_masked_rows(x64, target):
    weight = 2.0 * RNG.standard_normal((6, PARTS))
    cloud = make_cloud(17, 25)
    utility = nbv.SoftPartCount(Linear(jnp.asarray(weight)), target)
    assert float(utility(cloud)) == pytest.approx(by_hand(cloud, weight, target), rel=1e-12)
    # Contents of empty rows must not count.
    dirty = eqx.tree_at(lambda c: c.points, cloud, jnp.where(cloud.mask[:, None], cloud.points, 9.0))
    assert float(utility(dirty)) == float(utility(cloud))


def test_its_gradient_against_central_differences(x64):
    utility = nbv.SoftPartCount(Linear(jnp.asarray(2.0 * RNG.standard_normal((6, PARTS)))), 3.0)
    cloud = make_cloud(9, 12)

    def value(points, normals):
        return utility(nbv.PointCloud(points, normals, cloud.mask))

    slopes = jax.grad(value, argnums=(0, 1))(cloud.points, cloud.normals)
    for argument, slope in enumerate(slopes):
        for row, axis in [(0, 0), (4, 2), (8, 1), (11, 0)]:
            ends = []
            for step in (-1e-6, 1e-6):
                rows = [cloud.points, cloud.normals]
                rows[argument] = rows[argument].at[row, axis].add(step)
                ends.append(float(value(*rows)))
            assert float(slope[row, axis]) == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-6, abs=1e-9)
    # The last row is masked, and must have no gradient.
    assert not np.asarray(slopes[0])[9:].any()
    assert np.asarray(slopes[0])[:9].any()


def test_it_is_at_most_the_number_of_parts_and_zero_of_nothing():
    utility = nbv.SoftPartCount(Linear(jnp.zeros((6, PARTS))), 1.0)
    assert float(utility(make_cloud(400, 400))) == pytest.approx(PARTS)
    assert float(utility(nothing(4))) == 0.0


def test_counts_of_predicted_points():
    p = RNG.dirichlet(np.ones(PARTS), size=40)
    p[33:] = 0.0
    expected = np.bincount(p[:33].argmax(axis=1), minlength=PARTS)
    np.testing.assert_array_equal(part_counts(jnp.asarray(p, jnp.float32)), expected)


class Named(Linear):
    part_names: ClassVar[dict[int, str]] = {1: "seat", 3: "leg"}


def test_the_answer_counts_the_points_of_each_part():
    weight = jnp.asarray(2.0 * RNG.standard_normal((6, PARTS)))
    cloud = make_cloud(17, 25)
    counts = np.asarray(part_counts(Linear(weight)(cloud)))
    plain = nbv.SoftPartCount(Linear(weight)).answer(cloud)
    assert plain.parts == words_of(plain).shown == tuple(np.flatnonzero(counts))
    np.testing.assert_array_equal(plain.values, counts)
    named = nbv.ExpectedUtilityImprovement(nbv.SoftPartCount(Named(weight)), num_points=5).answer(cloud)
    said = words_of(named).said(plain)
    assert said == f"points predicted of seat {counts[1]} (was {counts[1]}), leg {counts[3]} (was {counts[3]})"
