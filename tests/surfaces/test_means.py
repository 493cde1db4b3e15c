"""Posteriors with prior mean functions, against regression in weight space on the data minus the means.

The means are sums of Gaussians and a quadratic, neither band-limited nor periodic, differentiated by hand in NumPy.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.stats import chi2
from weight_space import JointWeightSpace, WeightSpace
from weight_space import cloud as padded

import jaxnbv as nbv
from jaxnbv.surfaces import ValueRows

RNG = np.random.default_rng(0)
POINTS, NORMALS = RNG.uniform(-1.0, 1.0, (20, 3)), RNG.standard_normal((20, 3))
QUERIES = np.concatenate([POINTS[:3], RNG.uniform(-1.4, 1.4, (9, 3))])
AT, VALUES, VALUE_NOISE = RNG.uniform(-1.2, 1.2, (13, 3)), RNG.standard_normal(13), RNG.uniform(0.1, 1.0, 13)
CENTRES, HEIGHTS = RNG.uniform(-1.0, 1.0, (3, 4, 3)), RNG.standard_normal((3, 4))
QUADRATICS = (lambda q: q + q.transpose(0, 2, 1))(0.2 * RNG.standard_normal((3, 3, 3)))
WIDTH = 0.5
SCALES = {"one scale": ((0.1,), (0.8,)), "two scales": ((0.1, 0.3), (0.8, 0.6))}


class Bumps(nbv.surfaces.Fields):
    """sum_k a_sk exp(-|x - c_sk|^2 / 2 w^2) + x^T Q_s x / 2."""

    centres: Float[Array, "s k 3"]
    heights: Float[Array, "s k"]
    quadratics: Float[Array, "s 3 3"]

    def __call__(self, x):
        squared = jnp.sum((jnp.asarray(x)[:, None, None] - self.centres) ** 2, axis=-1)
        bumps = jnp.sum(self.heights * jnp.exp(-0.5 * squared / WIDTH**2), axis=-1).T
        return bumps + 0.5 * jnp.einsum("nd,sde,ne->sn", x, self.quadratics, x)


def bumps(dtype=None):
    return Bumps(*(jnp.asarray(a, dtype) for a in (CENTRES, HEIGHTS, QUADRATICS)))


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


def cloud(dtype=None):
    return padded(POINTS, NORMALS, 27, dtype)


def make(kind, scales, noise=0.2):
    base = nbv.GeometricSPSR(*SCALES[scales], truncation=3, noise=noise)
    return base if kind == "geometric" else nbv.ScreenedSPSR(base, (Given(),), level_deviation=0.7)


def regression(posterior, scales, s, x, noise=0.2):
    """Mean (n,) and covariance (n, n) about mean function s, relative to the posterior's level."""
    parts = [WeightSpace(ell, variance, noise, 1.5, 3) for ell, variance in zip(*SCALES[scales], strict=True)]
    less = NORMALS - exact(s, POINTS)[1]
    if hasattr(posterior, "value_unit"):
        h = float(posterior.value_unit)
        data = POINTS, less, noise, AT[:-1], h * VALUES[:-1] - exact(s, AT[:-1])[0], h * VALUE_NOISE[:-1]
        mean, covariance = JointWeightSpace(parts, 0.7).posterior(data, x)
        return exact(s, x)[0] + mean, covariance
    data = POINTS, less, noise, np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    mean, covariance = JointWeightSpace(parts, 0.0).posterior(data, np.concatenate([x, POINTS]))
    whole = np.concatenate([exact(s, x)[0], exact(s, POINTS)[0]]) + mean
    return whole[: len(x)] - whole[len(x) :].mean(), covariance[: len(x), : len(x)]


def mean_about(posterior, means):
    """Without noise. The key does not matter."""
    return posterior.sample_about(means, jax.random.key(7), 0)


BOTH = pytest.mark.parametrize("kind", ["geometric", "screened"])


@BOTH
@pytest.mark.parametrize("scales", SCALES)
def test_mean_about_functions_equals_regression_of_the_data_less_them(x64, kind, scales):
    posterior = make(kind, scales).condition(cloud())
    sample_mean = np.asarray(mean_about(posterior, bumps())(QUERIES) - posterior.level)
    for s in range(3):
        mean, _ = regression(posterior, scales, s, QUERIES)
        np.testing.assert_allclose(sample_mean[s], mean, atol=1e-9 * np.abs(mean).max())


@pytest.mark.parametrize("kind", [pytest.param("geometric", marks=pytest.mark.slow), "screened"])
def test_samples_about_functions_have_their_mean_and_the_scaled_covariance(x64, kind):
    """1,536 samples at twelve points, 512 about each of three functions with three scales. After whitening by the exact
    moments, z' z of the sample mean is chi-square, and the covariance is the identity within 4.5 standard errors."""
    posterior, scales = make(kind, "two scales").condition(cloud()), np.array([0.3, 1.0, 2.0])
    means = jax.tree.map(lambda leaf: jnp.repeat(leaf, 512, axis=0), bumps())
    fields = posterior.sample_about(means, jax.random.key(1), np.repeat(scales, 512))
    values = np.asarray(fields(QUERIES) - posterior.level).reshape(3, 512, 12)
    for s, scale in enumerate(scales):
        mean, covariance = regression(posterior, "two scales", s, QUERIES)
        z = np.linalg.solve(scale * np.linalg.cholesky(covariance), (values[s] - mean).T)
        assert 512 * np.sum(z.mean(axis=1) ** 2) < chi2.ppf(0.9999, 12)
        np.testing.assert_allclose(z @ z.T / 512, np.eye(12), atol=4.5 * np.sqrt(2 / 512))


@BOTH
def test_no_noise_gives_the_means_whatever_the_key(x64, kind):
    posterior, means = make(kind, "one scale").condition(cloud()), bumps()
    mean = mean_about(posterior, means)(QUERIES)
    first, other = (posterior.sample_about(means, jax.random.key(seed), 0)(QUERIES) for seed in (0, 1))
    assert bool((first == other).all())
    np.testing.assert_allclose(first, mean, rtol=0, atol=1e-13 * float(jnp.abs(mean).max()))
    mixed = posterior.sample_about(means, jax.random.key(0), jnp.array([0.0, 0.3, 0.0]))(QUERIES)
    np.testing.assert_allclose(mixed[::2], mean[::2], rtol=0, atol=1e-13 * float(jnp.abs(mean).max()))
    assert float(jnp.abs(mixed[1] - mean[1]).min()) > 1e-6


class Zeros(nbv.surfaces.Fields):
    count: int = eqx.field(static=True)

    def __call__(self, x):
        return jnp.zeros((self.count, len(x)), x.dtype)


@BOTH
@pytest.mark.parametrize("scale", [1, np.ones(4)], ids=str)
def test_means_of_zero_give_the_very_numbers_of_samples_about_none(kind, scale):
    posterior, x = make(kind, "two scales").condition(cloud(dtype=jnp.float32)), jnp.asarray(QUERIES, jnp.float32)
    about = posterior.sample_about(Zeros(4), jax.random.key(3), scale)
    plain = posterior.sample(jax.random.key(3), 4)
    assert bool((about.residual.coefficients == plain.coefficients).all())
    assert bool((about(x) == plain(x)).all())


def test_gradients_and_grids_of_samples_about_functions_are_those_of_their_values(x64):
    """Gradients against central differences, with an error of h^2 / 6 times a third derivative of order L^2. Nodes
    against points."""
    posterior = make("screened", "two scales").condition(cloud())
    fields = posterior.sample_about(bumps(), jax.random.key(0), 0.3)
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
def test_rows_that_hold_nothing_do_not_reach_the_derivatives_of_a_mean(x64, kind):
    """Empty rows are zeros, and the distance to the origin has no gradient there."""
    posterior = make(kind, "one scale").condition(cloud())

    def total(radius, turned):
        means = Balls(jnp.stack([radius, 2.0 * radius]))
        moved = eqx.tree_at(lambda p: p.cloud if kind == "geometric" else p.base.cloud, posterior, turned)
        return jnp.sum(mean_about(moved, means)(QUERIES)[:, 4:] ** 2)

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
@BOTH
def test_what_cannot_be_sampled_about_is_refused(kind, change, message):
    posterior = make(kind, "one scale").condition(cloud(dtype=jnp.float32))
    arguments = {"means": bumps(jnp.float32), "key": jax.random.key(0), "noise_scale": 1.0} | change
    with pytest.raises(nbv.InputError, match=message):
        posterior.sample_about(**arguments)


@BOTH
def test_means_that_are_not_finite_at_the_data_are_refused(kind):
    posterior = make(kind, "one scale").condition(cloud(dtype=jnp.float32))
    means = eqx.tree_at(lambda m: m.heights, bumps(jnp.float32), jnp.asarray(HEIGHTS, jnp.float32).at[1, 2].set(np.nan))
    with pytest.raises(nbv.InputError, match=r"1 of the 3 mean functions, the first of them number \[1\]"):
        posterior.sample_about(means, jax.random.key(0), 0.3)
