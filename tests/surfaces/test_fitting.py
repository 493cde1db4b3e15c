"""Hyperparameters by marginal likelihood: known ones are recovered from data drawn from the prior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from weight_space import WeightSpace

from jaxnbv import GeometricSPSR, OutsideBoundary, PointCloud, ScreenedSPSR, fit_hyperparameters

RNG = np.random.default_rng(0)
TRUE = {"lengthscale": 0.1, "variance": 0.8, "noise": 0.2}


def drawn(count):
    oracle, points = WeightSpace(**TRUE, truncation=5), RNG.uniform(-1.0, 1.0, (count, 3))
    normals = oracle.normal_features(points) @ RNG.standard_normal((oracle.num_weights, 3))
    normals += TRUE["noise"] * RNG.standard_normal(normals.shape)
    return PointCloud(jnp.asarray(points, jnp.float32), jnp.asarray(normals, jnp.float32), jnp.ones(count, bool))


@pytest.mark.parametrize("start", [(0.25, 0.4, 0.5), (0.05, 1.5, 0.08)], ids=str)
def test_known_values_are_recovered_from_data_of_the_prior(start):
    """750 numbers: the standard errors are some 4 % (lengthscale), 3 % (variance) and 5 % (noise)."""
    lengthscale, variance, noise = start
    model = GeometricSPSR(lengthscale, variance, truncation=5, noise=noise)
    fitted = fit_hyperparameters(model, drawn(250), jax.random.key(0))
    for name, value in TRUE.items():
        np.testing.assert_allclose(getattr(fitted, name), value, rtol=0.2, err_msg=name)


def test_of_a_screened_model_the_base_is_fitted_and_never_made_less_likely():
    data, base = drawn(100), GeometricSPSR(0.3, 0.3, truncation=5, noise=0.4)
    fitted = fit_hyperparameters(ScreenedSPSR(base, (OutsideBoundary(num_points=20),)), data, jax.random.key(0))
    assert fitted.base.condition(data).log_marginal_likelihood() > base.condition(data).log_marginal_likelihood() + 1.0
