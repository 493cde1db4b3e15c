"""The parts of the march: first roots of cubics against NumPy's, free distances against a distance transform."""

import jax.numpy as jnp
import numpy as np
import scipy.ndimage

from jaxnbv.scanning import cubic, tracing


def test_roots_of_cubics():
    rng = np.random.default_rng(12)
    c = rng.standard_normal((4, 5000))
    c[3, :500], c[2:, 500:1000] = 0.0, 0.0
    c = np.where(c[0] < 0, -c, c)
    expected = np.full(5000, np.inf)
    for i in range(5000):
        roots = np.roots(np.trim_zeros(c[::-1, i], "f"))
        real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real >= 0) & (roots.real <= 1)]
        expected[i] = real.min(initial=np.inf)
    _, found = cubic.first_bracket([jnp.asarray(row, jnp.float32) for row in c])
    root = cubic.first_root([jnp.asarray(row, jnp.float32) for row in c])
    # Double roots, and roots at an end of the interval, may fall either way in float32.
    assert (np.asarray(found) == np.isfinite(expected)).mean() > 0.999
    hit = np.isfinite(expected) & np.asarray(found)
    error = np.abs(np.asarray(root) - expected)[hit]
    value = np.abs(np.polynomial.polynomial.polyval(np.asarray(root, np.float64), c, tensor=False))[hit]
    assert value.max() < 1e-4
    assert np.mean(error < 1e-4) > 0.99


def test_free_distance_against_a_distance_transform():
    axis = np.linspace(-1.75, 1.75, 60)
    noise = scipy.ndimage.gaussian_filter(np.random.default_rng(13).standard_normal((60, 60, 60)), 1.2)
    values = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2) - 0.9 + 0.1 * noise / noise.std()
    distance = np.asarray(tracing.free_distance(jnp.asarray(values, jnp.float32)))
    positive = values > 0
    corners = [positive[i : i + 59, j : j + 59, k : k + 59] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    crossed = np.any(corners, axis=0) & ~np.all(corners, axis=0)
    exact = scipy.ndimage.distance_transform_cdt(~crossed, metric="chessboard")
    levels = np.array([0, 1, 2, 3, 5, 9, 17])
    np.testing.assert_array_equal(np.abs(distance), levels[np.searchsorted(levels, exact, side="right") - 1])
    np.testing.assert_array_equal(np.sign(distance), np.where(crossed, 0, np.where(corners[0], 1, -1)))
