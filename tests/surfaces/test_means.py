"""Posteriors with prior mean functions, against regression in weight space on the data minus the means.

The means are sums of Gaussians and a quadratic, neither band-limited nor periodic, differentiated by hand in NumPy.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from weight_space import JointWeightSpace, WeightSpace
from weight_space import cloud as padded

import jaxnbv as nbv
from jaxnbv.surfaces import ValueRows

pytestmark = pytest.mark.usefixtures("x64")
RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.uniform(-1.0, 1.0, (20, 3)), RNG.standard_normal((20, 3))
QUERIES = np.concatenate([POINTS[:3], RNG.uniform(-1.4, 1.4, (9, 3))])
AT, VALUES, VALUE_NOISE = RNG.uniform(-1.2, 1.2, (13, 3)), RNG.standard_normal(13), RNG.uniform(0.1, 1.0, 13)
CENTRES, HEIGHTS = RNG.uniform(-1.0, 1.0, (3, 4, 3)), RNG.standard_normal((3, 4))
QUADRATICS = (lambda q: q + q.transpose(0, 2, 1))(0.2 * RNG.standard_normal((3, 3, 3)))
WIDTH = 0.5
LENGTHSCALES, VARIANCES, NOISE = (0.1, 0.3), (0.8, 0.6), 0.2


class Bumps(nbv.surfaces.Fields):
    """sum_k a_sk exp(-|x - c_sk|^2 / 2 w^2) + x^T Q_s x / 2."""

    centres: Float[Array, "s k 3"]
    heights: Float[Array, "s k"]
    quadratics: Float[Array, "s 3 3"]

    def __call__(self, x):
        squared = jnp.sum((jnp.asarray(x)[:, None, None] - self.centres) ** 2, axis=-1)
        bumps = jnp.sum(self.heights * jnp.exp(-0.5 * squared / WIDTH**2), axis=-1).T
        return bumps + 0.5 * jnp.einsum("nd,sde,ne->sn", x, self.quadratics, x)


def bumps(factor=1.0):
    return Bumps(*(jnp.asarray(a) for a in (CENTRES, factor * HEIGHTS, factor * QUADRATICS)))


def exact(s, x):
    """Value (n,) and gradient (n, 3) of a mean function."""
    apart = x[:, None] - CENTRES[s]
    each = HEIGHTS[s] * np.exp(-0.5 * np.sum(apart**2, axis=-1) / WIDTH**2)
    value = each.sum(axis=1) + 0.5 * np.sum(x @ QUADRATICS[s] * x, axis=1)
    return value, -np.sum(each[..., None] * apart, axis=1) / WIDTH**2 + x @ QUADRATICS[s]


class Given(nbv.surfaces.ValueSource):
    """Values at points of the test. The last row is not filled."""

    def rows(self, observations):
        arrays = (jnp.asarray(a, observations.cloud.points.dtype) for a in (AT, VALUES, VALUE_NOISE))
        return ValueRows(*arrays, jnp.arange(13) < 12)


@functools.cache
def posterior_of(kind):
    base = nbv.GeometricSPSR(LENGTHSCALES, VARIANCES, truncation=3, noise=NOISE)
    model = base if kind == "geometric" else nbv.ScreenedSPSR(base, (Given(),), level_deviation=0.7)
    return model.condition(padded(POINTS, NORMALS, 27))


def regression(posterior, s, x):
    """Mean about mean function s, relative to the posterior's level."""
    scales = [WeightSpace(ell, variance, NOISE, 1.5, 3) for ell, variance in zip(LENGTHSCALES, VARIANCES, strict=True)]
    less = NORMALS - exact(s, POINTS)[1]
    if hasattr(posterior, "value_unit"):
        h = float(posterior.value_unit)
        data = POINTS, less, NOISE, AT[:-1], h * VALUES[:-1] - exact(s, AT[:-1])[0], h * VALUE_NOISE[:-1]
        return exact(s, x)[0] + JointWeightSpace(scales, 0.7).posterior(data, x)[0]
    data = POINTS, less, NOISE, np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    mean, _ = JointWeightSpace(scales, 0.0).posterior(data, np.concatenate([x, POINTS]))
    whole = np.concatenate([exact(s, x)[0], exact(s, POINTS)[0]]) + mean
    return whole[: len(x)] - whole[len(x) :].mean()


BOTH = pytest.mark.parametrize("kind", ["geometric", "screened"])


@BOTH
def test_without_noise_a_sample_is_the_regression_of_the_data_less_the_mean_for_any_key(kind):
    posterior = posterior_of(kind)
    first, other = (posterior.sample_about(bumps(), jax.random.key(seed), np.zeros(3))(QUERIES) for seed in (0, 1))
    assert bool((first == other).all())
    for s in range(3):
        mean = regression(posterior, s, QUERIES)
        np.testing.assert_allclose(first[s] - posterior.level, mean, atol=1e-9 * np.abs(mean).max())


@BOTH
def test_deviations_from_the_mean_are_scaled_and_the_same_for_all_mean_functions(kind):
    """They are those of samples about none with the same key, and about zero their very numbers."""
    posterior, key, scales = posterior_of(kind), jax.random.key(3), np.array([0.3, 0.0, 2.0])
    plain = posterior.sample(key, 3)
    mean = posterior.sample_about(bumps(), key, np.zeros(3))(QUERIES)
    deviation = posterior.sample_about(bumps(), key, scales)(QUERIES) - mean
    expected = scales[:, None] * (plain(QUERIES) - posterior.mean(QUERIES))
    np.testing.assert_allclose(deviation, expected, atol=1e-10 * float(jnp.abs(expected).max()))
    for scale in (1, np.ones(3)):
        about = posterior.sample_about(bumps(0.0), key, scale)
        assert bool((about.residual.coefficients == plain.coefficients).all())
        assert bool((about(QUERIES) == plain(QUERIES)).all())


def test_gradients_and_grids_of_samples_about_functions_are_those_of_their_values():
    """Gradients against central differences, with an error of h^2 / 6 times a third derivative of order L^2. Nodes
    against points."""
    fields = posterior_of("screened").sample_about(bumps(), jax.random.key(0), 0.3)
    gradient, h = np.asarray(fields.gradient(QUERIES)), 1e-4
    for axis, step in enumerate(h * np.eye(3)):
        difference = np.asarray(fields(QUERIES + step) - fields(QUERIES - step)) / (2 * h)
        np.testing.assert_allclose(gradient[..., axis], difference, atol=1e-6 * np.abs(gradient).max())
    axis = np.linspace(-1.3, 1.1, 5)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(fields.on_grid(axis).reshape(3, -1), fields(nodes), atol=1e-12)


class Balls(nbv.surfaces.Fields):
    """Distances to spheres about the origin, where they have no gradient."""

    radii: Float[Array, " s"]

    def __call__(self, x):
        return jnp.linalg.norm(x, axis=-1) - self.radii[:, None] ** 2


@BOTH
def test_rows_that_hold_nothing_do_not_reach_the_derivatives_of_a_mean(kind):
    """Empty rows are zeros, and the distance to the origin has no gradient there."""
    posterior = posterior_of(kind)

    def total(radius, turned):
        means = Balls(jnp.stack([radius, 2.0 * radius]))
        moved = eqx.tree_at(lambda p: p.cloud if kind == "geometric" else p.base.cloud, posterior, turned)
        return jnp.sum(moved.sample_about(means, jax.random.key(7), 0).residual.coefficients ** 2)

    here = posterior.cloud if kind == "geometric" else posterior.base.cloud
    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1), allow_int=True))
    of_radius, of_cloud = both(0.6, here)[1]
    difference = (both(0.6 + 1e-5, here)[0] - both(0.6 - 1e-5, here)[0]) / 2e-5
    np.testing.assert_allclose(of_radius, difference, rtol=1e-6, atol=1e-8)
    assert bool(jnp.isfinite(of_cloud.points).all())
    assert bool(jnp.isfinite(of_cloud.normals).all())


def flat(x):
    return jnp.zeros((1, len(x)))


class OneValue(nbv.surfaces.Fields):
    def __call__(self, x):
        return jnp.sum(x, axis=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise_scale": np.ones(2)}, r"noise scale has shape \(2,\), but there are 3 mean functions"),
        ({"noise_scale": np.array([1.0, -2.0, 0.0])}, r"a noise scale is -2; it must not be negative"),
        ({"noise_scale": np.inf}, "a noise scale is inf; it must be finite"),
        ({"means": flat}, r"sample_about's means is a function; give Fields"),
        ({"means": OneValue()}, r"mean functions give values \(\d+,\) at \d+ points"),
    ],
)
def test_what_cannot_be_sampled_about_is_refused(change, message):
    arguments = {"means": bumps(), "key": jax.random.key(0), "noise_scale": 1.0} | change
    with pytest.raises(nbv.InputError, match=message):
        posterior_of("screened").sample_about(**arguments)


def test_means_that_are_not_finite_at_the_data_are_refused():
    means = eqx.tree_at(lambda m: m.heights, bumps(), jnp.asarray(HEIGHTS).at[1, 2].set(np.nan))
    with pytest.raises(nbv.InputError, match=r"1 of the 3 mean functions, the first of them number \[1\]"):
        posterior_of("screened").sample_about(means, jax.random.key(0), np.zeros(3))
