"""Ray tracing in sampled fields against closed forms, a float64 brute-force march and Embree on marching cubes;
properties; and the parts of the march."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
from bumps import GRID, random_rays, rough_values
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from on_grid import nodes

import jaxnbv as nbv
from jaxnbv.scanning import cubic, tracing

CAMERA = nbv.Camera(height=40, width=40)


def sphere(grid=GRID, radius=1.0):
    return nbv.scanning.GridSurface.from_values(np.linalg.norm(nodes(grid.axis), axis=-1), radius, grid)


def interpolate(values, points, grid):
    """The trilinear interpolant in float64."""
    position = (np.asarray(points, np.float64) + grid.half_extent) / grid.spacing
    return scipy.ndimage.map_coordinates(np.asarray(values, np.float64), position.T, order=1, mode="nearest")


# Linear interpolation of f errs by at most h^2 / 8 (|f_xx| + |f_yy| + |f_zz|). Rounding of coordinates adds 2e-6.
def interpolation_error(curvatures):
    return GRID.spacing**2 / 8 * curvatures + 2e-6


def test_sphere_closed_form():
    origins, directions = random_rays(0, 4000, spread=1.5)
    hits = sphere().trace(origins, directions)
    points, mask = np.asarray(hits.points, np.float64), np.asarray(hits.mask)
    # f = |x| has second derivatives of 2 / |x| in total, at nodes inside by a cell's diagonal at most.
    error = interpolation_error(2 / (1 - 2 * GRID.spacing))
    o, d = origins.astype(np.float64), directions.astype(np.float64)
    along = -np.sum(o * d, axis=1)
    squared = np.sum(o**2, axis=1) - along**2
    clear = np.abs(np.sqrt(squared) - 1) > error
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(mask[clear], (squared < 1)[clear])
    assert np.abs(np.linalg.norm(points[mask], axis=1) - 1).max() < error
    steep = mask & (squared < 0.5)
    t = along - np.sqrt(np.maximum(1 - squared, 0))
    # Where the ray meets the sphere at 45 degrees or more, an error of f moves the hit by at most sqrt(2) times the
    # error.
    assert np.abs(points - (o + t[:, None] * d))[steep].max() < 1.6 * error
    assert np.all(points[~mask] == 0)
    assert np.all(np.asarray(hits.normals)[~mask] == 0)
    # Central differences of |x| err by h^2 / 6 |f_xxx| < h^2 / 2, and interpolation by no more.
    assert np.abs(np.asarray(hits.normals)[mask] - points[mask]).max() < 2 * GRID.spacing**2


def brute_force(values, origins, directions, grid, step):
    """t at the first change of sign of the interpolant in the box, by dense sampling in float64. Infinite if there is
    none."""
    o, d = origins.astype(np.float64), directions.astype(np.float64)
    result = np.full(len(o), np.inf)
    for i in range(len(o)):
        with np.errstate(divide="ignore"):
            sides = np.sort([(-grid.half_extent - o[i]) / d[i], (grid.half_extent - o[i]) / d[i]], axis=0)
        start, end = max(sides[0].max(), 0.0), sides[1].min()
        if start < end:
            t = np.arange(start, end, step)
            positive = interpolate(values, o[i] + t[:, None] * d[i], grid) > 0
            changed = np.flatnonzero(positive != positive[0])
            result[i] = t[changed[0]] if changed.size else np.inf
    return result


@pytest.mark.parametrize("amplitude", [0.05, 0.5])
def test_brute_force_march(amplitude):
    grid = nbv.Grid(32, 1.5)
    values = rough_values(grid, 3, amplitude).astype(np.float32)
    surface = nbv.scanning.GridSurface.from_values(values, 0.0, grid)
    outside, inside = random_rays(4, 200), random_rays(5, 100, radius=0.6)
    origins, directions = (np.concatenate(pair) for pair in zip(outside, inside, strict=True))
    hits = surface.trace(origins, directions)
    step = 0.004 * grid.spacing
    expected = brute_force(values, origins, directions, grid, step)
    traced = np.where(hits.mask, np.linalg.norm(np.asarray(hits.points) - origins, axis=1), np.inf)
    assert 100 < np.isfinite(expected).sum() <= 300
    late = np.subtract(traced, expected, out=np.zeros(300), where=np.isfinite(traced) | np.isfinite(expected))
    # The march never ends after the brute force. It may end earlier, if two zeros lie within one brute-force step.
    assert late.max() < 0.01 * grid.spacing
    early = late < -0.01 * grid.spacing
    assert early.mean() < 0.02
    scale = np.abs(np.diff(values, axis=0)).max()
    assert np.abs(interpolate(values, hits.points[hits.mask], grid)).max() < 1e-4 * scale


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=25)
@given(unit, unit, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_no_tunnelling_through_a_two_voxel_sheet(normal, direction, shift, slide):
    grid = nbv.Grid(40, 1.75)
    h = grid.spacing
    n, d = (np.array(v) / np.linalg.norm(v) for v in (normal, direction))
    side = -np.sign(d @ n)
    # A flatter ray may start within the sheet.
    assume(abs(d @ n) > 0.15)
    surface = nbv.scanning.GridSurface.from_values(np.abs(nodes(grid.axis) @ n - shift) - h, 0.0, grid)
    across = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    targets = shift * n + np.linspace(-0.5, 0.5, 64)[:, None] * across + slide * np.cross(n, across)
    hits = surface.trace((targets - 4 * d).astype(np.float32), np.broadcast_to(d, (64, 3)).astype(np.float32))
    assert np.asarray(hits.mask).all()
    # By Jensen's inequality the interpolant of |n.x - c| lies between |n.x - c| and sqrt((n.x - c)^2 + h^2 / 4).
    depth = side * (np.asarray(hits.points, np.float64) @ n - shift) / h
    assert depth.min() > np.sqrt(0.75) - 1e-4
    assert depth.max() < 1 + 1e-4


def test_axis_parallel_rays_through_nodes_and_edges():
    grid = nbv.Grid(33, 1.6)
    values = rough_values(grid, 7, 0.1).astype(np.float32)
    surface = nbv.scanning.GridSurface.from_values(values, 0.0, grid)
    a, b = np.meshgrid(grid.axis[1:-1], grid.axis[1:-1] + 0.25 * grid.spacing * (np.arange(31) % 3))
    a, b = a.ravel(), b.ravel()
    for axis in range(3):
        for sign in (-1.0, 1.0):
            origins = np.insert(np.stack([a, b], axis=1), axis, -3.0 * sign, axis=1).astype(np.float32)
            directions = np.tile(sign * np.eye(3, dtype=np.float32)[axis], (len(a), 1))
            hits = surface.trace(origins, directions)
            expected = brute_force(values, origins[::37], directions[::37], grid, 0.004 * grid.spacing)
            traced = np.where(hits.mask, np.abs(np.asarray(hits.points)[:, axis] + 3.0 * sign), np.inf)[::37]
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(hits))
            assert np.isfinite(expected).sum() > 5
            np.testing.assert_array_equal(np.isinf(traced), np.isinf(expected))
            hit = np.isfinite(expected)
            assert np.abs(traced[hit] - expected[hit]).max() < 0.02 * grid.spacing


def test_far_origins_and_rays_on_the_border_of_the_box():
    far, edges = [[0, 0, -500]], [[1.75, 1.75, -3], [1.75, 0, -3], [-1.75, -1.75, -3], [0, 0, 1.75]]
    origins = np.resize(np.array(far + edges, np.float32), (4000, 3))
    hits = sphere().trace(origins, np.tile(np.array([0, 0, 1], np.float32), (4000, 1)))
    np.testing.assert_allclose(hits.points[0], [0, 0, -1], atol=interpolation_error(2.2) + 500 * 1e-6)
    assert not np.asarray(hits.mask)[1:5].any()


@pytest.mark.as_users
def test_samples_in_a_batch_equal_single_ones():
    values = np.stack([rough_values(GRID, seed, 0.1) for seed in range(2)]).astype(np.float32)
    surfaces = nbv.scanning.GridSurface.from_values(values, 0.05, GRID)
    poses = nbv.look_at(nbv.geometry.fibonacci_sphere(3, 2.5))
    clouds = nbv.scanning.scan_samples(surfaces, CAMERA, poses)
    assert clouds.points.shape == (2, 3, 1600, 3)
    assert clouds.mask.shape == (2, 3, 1600)

    # Another compilation rounds the rays differently, which may change a few at the silhouettes.
    def differs(a, b):
        return np.abs(np.asarray(a) - np.asarray(b)).max(axis=-1) > 1e-5

    for i in range(2):
        single = nbv.scanning.GridSurface.from_values(values[i], 0.05, GRID)
        np.testing.assert_array_equal(single.distance, surfaces.distance[i])
        for j in range(3):
            expected = nbv.scan(single, CAMERA, poses[j])
            assert (clouds.mask[i, j] != expected.mask).mean() <= 0.002
            assert differs(clouds.points[i, j], expected.points).mean() <= 0.002


def test_normals_are_interpolated_central_differences():
    values = rough_values(GRID, 14, 0.1).astype(np.float32)
    hits = nbv.scanning.GridSurface.from_values(values, 0.0, GRID).trace(*random_rays(15, 4000))
    points = np.asarray(hits.points, np.float64)[np.asarray(hits.mask)]
    gradient = np.stack([interpolate(g, points, GRID) for g in np.gradient(values.astype(np.float64))], axis=1)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    normals = np.asarray(hits.normals)[np.asarray(hits.mask)]
    np.testing.assert_allclose(np.abs(np.sum(normals * gradient, axis=1)), 1.0, atol=1e-4)
    directions = random_rays(15, 4000)[1][np.asarray(hits.mask)]
    assert (np.sum(normals * directions, axis=1) <= 1e-6).all()


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
    _, has_root = cubic.first_bracket([jnp.asarray(row, jnp.float32) for row in c])
    root = cubic.first_root([jnp.asarray(row, jnp.float32) for row in c])
    # Double roots, and roots at an end of the interval, may be missed or not in float32.
    assert (np.asarray(has_root) == np.isfinite(expected)).mean() > 0.999
    hit = np.isfinite(expected) & np.asarray(has_root)
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


def test_outside_a_grid_there_is_no_cell():
    """Indices do not count from the other end either."""
    grid = nbv.Grid(11, 1.0)
    cells = np.asarray(grid.cell_of(jnp.array([[-0.99, 0.01, 0.99], [-1.01, -3.0, 1.01]])))
    np.testing.assert_array_equal(cells[0], [0, 5, 9])
    assert (cells[1] >= 10).all()
