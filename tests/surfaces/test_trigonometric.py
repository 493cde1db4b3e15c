"""Band-limited fields: values, grids and derivatives against plain sums, automatic and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxnbv as nbv
from jaxnbv.surfaces.trigonometric import NonuniformTransform, TrigonometricFields, differentiate, solve_poisson

RNG = np.random.default_rng(0)
L = 4
COEFFICIENTS = np.random.default_rng(0).standard_normal((2, 3, 2 * L + 1, 2 * L + 1, 2 * L + 1))
POINTS = np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 3))


def direct(coefficients, x):
    """The documented basis, as a product of functions of one variable."""
    phi = [[np.cos(a * t) if a >= 0 else np.sin(-a * t) for a in range(-L, L + 1)] for t in x.T]
    return np.einsum("sabc,an,bn,cn->sn", coefficients, *np.array(phi))


@pytest.mark.parametrize("chunk", [1 << 24, 500])
def test_values_at_points_equal_the_direct_sum(x64, monkeypatch, chunk):
    """The small chunk splits the 20 points into pieces, and the last one is not full."""
    monkeypatch.setattr("jaxnbv.surfaces.trigonometric._CHUNK_VALUES", chunk)
    fields = TrigonometricFields(jnp.asarray(COEFFICIENTS[0]))
    np.testing.assert_allclose(fields(POINTS), direct(COEFFICIENTS[0], POINTS), atol=1e-11)


def test_grid_point_and_default_slab_evaluation_agree(x64):
    fields = TrigonometricFields(jnp.asarray(COEFFICIENTS[0]))
    axis = np.linspace(-1.7, 1.3, 7)
    nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = direct(COEFFICIENTS[0], nodes).reshape(3, 7, 7, 7)
    np.testing.assert_allclose(fields.on_grid(axis), expected, atol=1e-11)
    np.testing.assert_allclose(nbv.surfaces.Fields.on_grid(fields, axis), expected, atol=1e-11)


def test_ways_to_the_gradient_agree(x64):
    fields = TrigonometricFields(jnp.asarray(COEFFICIENTS[0]))
    ways = fields.gradient, lambda x: nbv.surfaces.Fields.gradient(fields, x), jax.jacobian(fields)
    own, default, jacobian = jax.jit(lambda x: [way(x) for way in ways])(jnp.asarray(POINTS))
    automatic = np.einsum("snnd->nsd", jacobian)
    np.testing.assert_allclose(own, automatic.transpose(1, 0, 2), atol=1e-10)
    np.testing.assert_allclose(default, automatic.transpose(1, 0, 2), atol=1e-10)
    derivatives = jax.jit(
        lambda x: [TrigonometricFields(differentiate(fields.coefficients, axis))(x) for axis in range(3)]
    )(POINTS)
    for axis, derivative in enumerate(derivatives):
        np.testing.assert_allclose(derivative, automatic[..., axis].T, atol=1e-10)
        step = 1e-5 * np.eye(3)[axis]
        central = (direct(COEFFICIENTS[0], POINTS + step) - direct(COEFFICIENTS[0], POINTS - step)) / 2e-5
        np.testing.assert_allclose(derivative, central, atol=1e-6)


def test_poisson_solution_has_the_divergence_as_laplacian_and_mean_zero(x64):
    """Laplacian f = div v at points, with derivatives by central differences of values. h^2 L^2 / 12 is 1.3e-6."""
    v = COEFFICIENTS[:1]
    f = np.asarray(solve_poisson(jnp.asarray(v)))
    h, points = 1e-3, POINTS[:6]

    def shifted(field, axis, sign):
        return direct(field, points + sign * h * np.eye(3)[axis])

    second = sum(shifted(f, d, 1) + shifted(f, d, -1) - 2 * direct(f, points) for d in range(3)) / h**2
    divergence = sum((shifted(v[:, d], d, 1) - shifted(v[:, d], d, -1)) / (2 * h) for d in range(3))
    np.testing.assert_allclose(second, divergence, atol=1e-5 * np.abs(divergence).max())
    assert f[0, L, L, L] == 0


def points_with_borders(count):
    points = RNG.uniform(-np.pi / 2, np.pi / 2, (count, 3))
    points[:8] = np.pi / 2 * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    points[8] = [np.pi / 2, 0.0, -np.pi / 2]
    return points


def relative(actual, expected):
    expected = np.asarray(expected, np.float64)
    return np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("truncation", [1, 4, 20])
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-5), (np.float64, 1e-10)])
def test_transform_and_adjoint_equal_direct_sums(truncation, dtype, tolerance):
    """White coefficients, so that high frequencies count as much as low ones, and points that include corners of the
    scene and nodes of the transform. Relative errors, in the norm and, ten times as large, at the worst point."""
    modes = 2 * truncation + 1
    points = points_with_borders(60).astype(dtype)
    points[10:20] = -np.pi / 2 + np.pi / (2 * truncation) * RNG.integers(0, modes, (10, 3))
    points = np.clip(points, -dtype(np.pi / 2), dtype(np.pi / 2))
    coefficients, values = RNG.standard_normal((2, modes, modes, modes)), RNG.standard_normal((60, 2))
    factors = []
    for x in points.T.astype(np.float64):
        angle = x[:, None] * np.arange(-truncation, truncation + 1)
        factors.append(np.where(np.arange(modes) >= truncation, np.cos(angle), np.sin(-angle)))
    expected = np.einsum("kabc,na,nb,nc->nk", coefficients, *factors, optimize=True)
    spread = np.einsum("nk,na,nb,nc->kabc", values, *factors, optimize=True)
    with jax.enable_x64(dtype is np.float64):

        @jax.jit
        def both(points, coefficients, values):
            transform = NonuniformTransform(points, truncation)
            return transform.evaluate(coefficients), transform.adjoint(values)

        results = both(*(jnp.asarray(a, dtype) for a in (points, coefficients, values)))
    actual, adjoint = (np.asarray(result) for result in results)
    assert actual.dtype == adjoint.dtype == dtype
    assert relative(actual, expected) < tolerance
    assert np.abs(actual - expected).max() < 10 * tolerance * expected.std()
    assert relative(adjoint, spread) < tolerance
    left, right = np.vdot(actual, values), np.vdot(coefficients, adjoint)
    scale = np.linalg.norm(actual) * np.linalg.norm(values)
    assert abs(left - right) < (1e-13 if dtype == np.float64 else 1e-6) * scale


def test_the_transform_beyond_the_scene_is_exact_or_nan(x64):
    """One grid step beyond pi/2, here 0.39, windows still lie within the grid."""
    places = np.array([-3.1, -2.4, -1.6, -1.5, 0.3, 1.5, 1.7, 2.2, 3.1, np.nan, np.inf])
    points = np.stack([places, np.full(11, 0.2), np.full(11, -0.4)], axis=1)
    points = np.concatenate([np.roll(points, axis, axis=1) for axis in range(3)])

    @jax.jit
    def both(points):
        transform = NonuniformTransform(points, L)
        return transform.evaluate(jnp.asarray(COEFFICIENTS[0])), transform.adjoint(jnp.ones((33, 1)))

    evaluated, spread = map(np.asarray, both(jnp.asarray(points)))
    actual = evaluated.T
    furthest = np.abs(points).max(axis=1)
    with np.errstate(invalid="ignore"):
        exact = direct(COEFFICIENTS[0], points)
    np.testing.assert_array_equal(np.isnan(actual).all(axis=0), ~(furthest < 2.0))
    np.testing.assert_allclose(actual[:, furthest < 2.0], exact[:, furthest < 2.0], atol=1e-10)
    assert np.isnan(spread).all()


def test_a_gpu_spreads_as_a_cpu_does(monkeypatch):
    points, values = jnp.asarray(points_with_borders(60)), jnp.asarray(RNG.standard_normal((60, 2)))
    spread = lambda points, values: NonuniformTransform(points, 4).adjoint(values)  # noqa: E731
    on_cpu = jax.jit(spread)(points, values)
    monkeypatch.setattr("jaxnbv.surfaces.trigonometric.on_cpu", lambda: False)
    # Another function, which is traced again.
    assert relative(jax.jit(lambda *data: spread(*data))(points, values), on_cpu) < 1e-6


def test_gradients_on_nodes_and_borders_are_those_of_the_function():
    """The window of a point on a node ends exactly on its last node, where the square root starts."""
    nodes = -np.pi / 2 + np.pi / 12 * np.arange(13)
    points = jnp.asarray(np.stack([nodes, nodes[::-1], nodes], axis=1), jnp.float32)
    coefficients = jnp.asarray(RNG.standard_normal((1, 13, 13, 13)), jnp.float32)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(NonuniformTransform(x, 6).evaluate(coefficients))))(points)
    exact = jax.jit(jax.grad(lambda x: jnp.sum(TrigonometricFields(coefficients)(x))))(points)
    np.testing.assert_allclose(gradient, exact, atol=1e-3 * float(jnp.abs(exact).max()))
