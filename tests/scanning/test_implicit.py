"""Derivatives of hits and normals in the camera's pose: differences, Optimistix, closed forms, loops.

A scan is smooth in its pose as long as every ray meets the same piece of the surface. It jumps where a ray crosses a
silhouette or an edge where two parts of a solid meet; on a grid its derivative jumps where a hit crosses from one cell
into the next; and where a ray grazes the surface the derivative is bounded on purpose. There no derivative equals a
difference: such rays are left out, and they must be few.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.scipy.ndimage import map_coordinates

from jaxnbv.camera import Camera, fibonacci_sphere, look_at
from jaxnbv.scanning.grid import Grid, GridSurface
from jaxnbv.scanning.implicit import implicit_depth
from jaxnbv.scanning.scanner import scan
from jaxnbv.scanning.sdf import Box, Cylinder, Sphere, Torus
from jaxnbv.scanning.sphere_tracing import SDFSurface
from jaxnbv.search.pose_space import FreePoses, SpherePoses

RNG = np.random.default_rng(0)
GRID, SMALL = Grid(60, 1.75), Grid(20, 1.75)
CAMERA, FEW = Camera(height=24, width=24), Camera(height=6, width=6)
# Nearly all the time goes into compilation: this halves it.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
SPACES = {"sphere": SpherePoses(), "free": FreePoses()}


def solid():
    bored = Box([0.7, 0.5, 0.6], 0.1) - Cylinder(0.3, 2.0)
    return bored | Torus(0.5, 0.15).rotate([1.0, 1.0, 0.0], 0.8).translate([0.3, 0.5, 0.2])


def nodes(grid):
    return np.stack(np.meshgrid(grid.axis, grid.axis, grid.axis, indexing="ij"), axis=-1)


def is_grazing(surface, points, normals, directions):
    """Whether the slope along a ray is, but for a little, below what it is held at.

    On a solid a sine of 0.05; on a grid 0.03 of the spread of f over the corners of the hit's cell.
    """
    if isinstance(surface, SDFSurface):
        return -np.sum(normals * directions, axis=-1) < 0.055
    position = (points + GRID.half_extent) / GRID.spacing
    cell = np.floor(position).astype(int)
    offsets = np.array(list(np.ndindex(2, 2, 2)))
    corners = np.asarray(surface.values)[tuple(np.moveaxis(cell[..., None, :] + offsets, -1, 0))]

    def f(at):
        return np.sum(corners * np.prod(np.where(offsets, at[..., None, :], 1 - at[..., None, :]), axis=-1), axis=-1)

    slope = (f(position - cell + 1e-4 * directions) - f(position - cell - 1e-4 * directions)) / 2e-4
    return np.abs(slope) < 0.033 * np.ptp(corners, axis=-1)


class Bumps(eqx.Module):
    """|x| - 0.9 and a dozen random waves: smooth and band-limited but for the ball's centre."""

    waves: jax.Array
    phases: jax.Array

    def __call__(self, x):
        return jnp.sqrt(jnp.sum(x**2, axis=-1)) - 0.9 + 0.03 * jnp.sum(jnp.cos(x @ self.waves + self.phases), axis=-1)


def some_bumps():
    return Bumps(jnp.asarray(RNG.integers(-3, 4, (3, 12)) * 1.0), jnp.asarray(RNG.uniform(0, 2 * np.pi, 12)))


def grid_surface(field, grid):
    return GridSurface.from_values(field(jnp.asarray(nodes(grid))), 0.0, grid)


def small_surfaces(count):
    values = np.stack([some_bumps()(nodes(SMALL)) for _ in range(count)])
    return GridSurface.from_values(values, 0.0, SMALL)


def some_rays(count, spread=0.7):
    origins = RNG.normal(size=(count, 3))
    origins *= 2.5 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = RNG.uniform(-spread, spread, (count, 3)) - origins
    return jnp.asarray(origins), jnp.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


@functools.cache
def looks(space):
    """Points, normals, mask and rays at parameters + h step; and the derivatives in h, forwards, of the first two."""

    def look(surface, start, parameters, step, h):
        pose = SPACES[space].retract(start, parameters + h * step)
        cloud = scan(surface, CAMERA, pose)
        return (cloud.points, cloud.normals), (cloud.mask, CAMERA.rays(pose)[1])

    def both(surface, start, parameters, step, h):
        return jax.jvp(lambda h: look(surface, start, parameters, step, h), (h,), (1.0,), has_aux=True)

    return quick_jit(jax.vmap(jax.vmap(both, (None, 0, 0, 0, None)), (None, None, None, None, 0)))


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", ["field", "distances on a grid", "solid"])
def test_scans_as_functions_of_a_pose_against_central_differences(name, space, x64):
    if name == "solid":
        surface = SDFSurface(solid())
    else:
        surface = grid_surface(some_bumps() if name == "field" else solid(), GRID)
    starts, count, h = look_at(fibonacci_sphere(6, 2.5)), SPACES[space].num_parameters, 1e-6
    at, step = 0.1 * RNG.normal(size=(6, count)), RNG.normal(size=(6, count))
    values, slopes, (masks, rays) = looks(space)(surface, starts, at, step, jnp.asarray([0.0, h, -h]))
    points, normals = (np.asarray(value) for value in values)
    masks, hit = np.asarray(masks), np.asarray(masks[0])
    grazing = hit & is_grazing(surface, points[0], normals[0], np.asarray(rays[0]))
    # Edges turn a normal at once; curvature, by no more than some hundred times the step.
    kept = (masks == hit).all(axis=0) & (np.abs(normals - normals[0]).max(axis=(0, -1)) < 1e-3)
    if name != "solid":
        cells = np.floor((points + GRID.half_extent) / GRID.spacing)
        kept &= (cells == cells[0]).all(axis=(0, -1))
    assert 0.6 < hit.mean() < 1
    assert (~kept).sum() < 0.005 * hit.sum()
    assert grazing.sum() < 0.02 * hit.sum()
    kept &= hit & ~grazing
    for value, slope in ((points, slopes[0][0]), (normals, slopes[1][0])):
        central = (value[1] - value[2]) / (2 * h)
        error = np.abs(slope - central)[kept] / (1 + np.abs(central[kept]).max(axis=-1, keepdims=True))
        assert error.max() < 1e-5
        assert np.isfinite(slope).all()
        assert not np.asarray(slope)[~hit].any()


class Along(eqx.Module):
    """A function along rays, all of which can be differentiated in."""

    function: eqx.Module
    origins: jax.Array
    directions: jax.Array

    def __call__(self, depth):
        return self.function(self.origins + depth[:, None] * self.directions)


class Interpolant(eqx.Module):
    values: jax.Array

    def __call__(self, x):
        position = (x + GRID.half_extent) / GRID.spacing
        return map_coordinates(self.values, [position[:, axis] for axis in range(3)], order=1)


def optimistix_depth(along, near):
    """The roots by Newton's method, differentiated by Optimistix' own implicit adjoint."""

    def root(function, origin, direction, near):
        solver = optx.Newton(rtol=1e-13, atol=1e-13)
        return optx.root_find(
            lambda t, ray: ray[0]((ray[1] + t * ray[2])[None])[0], solver, near, (function, origin, direction)
        ).value

    return jax.vmap(root, (None, 0, 0, 0))(along.function, along.origins, along.directions, near)


@pytest.mark.parametrize("name", ["waves", "solid", "grid"])
def test_gradients_of_depths_equal_those_of_optimistix(name, x64):
    bumps = some_bumps()
    function = {"waves": bumps, "solid": solid(), "grid": Interpolant(bumps(jnp.asarray(nodes(GRID))))}[name]
    surface = SDFSurface(solid()) if name == "solid" else grid_surface(bumps, GRID)
    origins, directions = some_rays(60)
    hits = surface.trace(origins, directions)
    use = np.asarray(hits.mask) & (-np.sum(hits.normals * directions, axis=1) > 0.2)
    origins, directions = origins[use], directions[use]
    near = jnp.sum((hits.points[use] - origins) * directions, axis=1)
    along = Along(function, origins, directions)
    weights = jnp.asarray(RNG.normal(size=len(near)))
    depth = optimistix_depth(along, near)

    def ours(along):
        if name == "waves":
            held = jnp.full(len(near), 0.01)
            return weights @ implicit_depth(along, jax.lax.stop_gradient(depth), held > 0, held)
        if name == "solid":
            traced = SDFSurface(along.function)
        else:
            traced = GridSurface(along.function.values, surface.distance, GRID)
        points = traced.trace(along.origins, along.directions).points
        offset, square = points - along.origins, jnp.sum(along.directions**2, axis=1)
        return weights @ (jnp.sum(offset * along.directions, axis=1) / square)

    assert len(near) > 30
    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(ours))(along)
    expected = eqx.filter_jit(eqx.filter_grad(lambda along: weights @ optimistix_depth(along, near)))(along)
    np.testing.assert_allclose(value, weights @ depth, rtol=1e-10)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)


def test_rule_on_straight_functions_by_hand():
    """f = s t - c has dt/dc = 1 / s, with |s| held at 0.1 and its sign kept; and no derivative where nothing is hit."""

    class Line(eqx.Module):
        slope: jax.Array
        rise: jax.Array

        def __call__(self, t):
            return self.slope * t - self.rise

    slope = jnp.asarray([2.0, -0.5, 0.05, -0.05, 0.0, 2.0])
    depth, mask = jnp.arange(6.0), jnp.arange(6) < 5

    def run(rise):
        return implicit_depth(Line(slope, rise), depth, mask, jnp.full(6, 0.1))

    for jacobian in (jax.jacfwd(run), jax.jacrev(run)):
        np.testing.assert_allclose(jacobian(slope * depth), np.diag([0.5, -2.0, 10.0, -10.0, 10.0, 0.0]), rtol=1e-6)
    np.testing.assert_array_equal(run(slope * depth), depth)


@pytest.mark.parametrize("name", ["solid", "grid"])
def test_grazing_and_missed_rays(name):
    """A ball of 0.9: slopes as great as the rays graze but bounded, and zero, to the last bit, beside it."""
    surface = SDFSurface(Sphere(0.9)) if name == "solid" else grid_surface(Sphere(0.9), GRID)
    # The ball on the grid is smaller by up to 1.2e-3.
    miss = 0.9 + np.linspace(-4e-3, 1e-3, 200)
    turn = RNG.uniform(0, 2 * np.pi, 200)
    origins = jnp.asarray(np.stack([miss * np.cos(turn), miss * np.sin(turn), 0 * miss - 2.5], axis=1), jnp.float32)
    directions = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), (200, 3))
    mask = np.asarray(surface.trace(origins, directions).mask)
    assert 0.5 < mask.mean() < 0.9

    def trace(origin, direction):
        hits = surface.trace(origin[None], direction[None])
        return hits.points[0], hits.normals[0]

    forward = quick_jit(jax.vmap(jax.jacfwd(trace, argnums=(0, 1))))(origins, directions)
    reverse = quick_jit(jax.vmap(jax.jacrev(trace, argnums=(0, 1))))(origins, directions)
    # |dt| is at most 1 / 0.05 or 1 / 0.03 of what moves: the origin, or the hit, which is 4 away from it at most.
    bound = 1 + (20 if name == "solid" else 34)
    for jacobian in (forward, reverse):
        for (by_origin, by_direction), curvature in zip(jacobian, (1.0, 2 / 0.9), strict=True):
            assert np.isfinite(by_origin).all()
            assert np.isfinite(by_direction).all()
            lengths = np.linalg.norm(by_origin, ord=2, axis=(1, 2))
            assert 5 < lengths.max() < bound * curvature
            assert np.linalg.norm(by_direction, ord=2, axis=(1, 2)).max() < 4 * bound * curvature
            assert not np.asarray(by_origin)[~mask].any()
            assert not np.asarray(by_direction)[~mask].any()
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(reverse), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-3)


def seen(space, weights, surface, start, parameters):
    cloud = scan(surface, FEW, space.retract(start, parameters))
    return jnp.sum(weights[0] * cloud.points) + jnp.sum(weights[1] * cloud.normals)


def test_batches_of_surfaces_and_starts_equal_loops_forwards_and_backwards(x64):
    """Starts within surfaces, and surfaces within starts."""
    surfaces, starts, space = small_surfaces(16), look_at(fibonacci_sphere(3, 2.5)), SPACES["free"]
    parameters, weights = (
        jnp.asarray(0.05 * RNG.normal(size=(3, 9))),
        jnp.asarray(RNG.normal(size=(2, FEW.num_rays, 3))),
    )

    def seen(values, distance, start, parameters):
        cloud = scan(GridSurface(values, distance, SMALL), FEW, space.retract(start, parameters))
        return jnp.sum(weights[0] * cloud.points) + jnp.sum(weights[1] * cloud.normals)

    def reverse(surface, *pose):
        return jax.value_and_grad(seen, argnums=(0, 3))(surface.values, surface.distance, *pose)

    def forward(surface, *pose):
        return jax.jacfwd(seen, argnums=3)(surface.values, surface.distance, *pose)

    of_surface, of_start = (0, None, None), (None, 0, 0)
    arguments = surfaces, starts, parameters
    outer = quick_jit(jax.vmap(jax.vmap(reverse, of_start), of_surface))(*arguments)
    inner = quick_jit(jax.vmap(jax.vmap(reverse, of_surface), of_start))(*arguments)
    ahead = quick_jit(jax.vmap(jax.vmap(forward, of_start), of_surface))(*arguments)
    assert (np.abs(ahead).max(axis=-1) > 0.1).all()
    alone = quick_jit(reverse)
    for i, j in np.ndindex(16, 3):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], surfaces), starts[j], parameters[j]
        single = alone(*one)
        for a, b, c in zip(*map(jax.tree.leaves, (outer, inner, single)), strict=True):
            np.testing.assert_allclose(a[i, j], c, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(b[j, i], c, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ahead[i, j], single[1][1], rtol=1e-9, atol=1e-9)


def traced(weights, surface, origins, directions):
    def total(values, origins, directions):
        hits = GridSurface(values, surface.distance, SMALL).trace(origins, directions)
        return jnp.sum(weights[0] * hits.points) + jnp.sum(weights[1] * hits.normals), hits.mask

    return jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(surface.values, origins, directions)


@pytest.mark.parametrize("axes", [(0, 0, 0), (0, None, None), (None, 0, None)])
def test_every_way_to_batch_fields_and_rays_equals_a_loop(axes, x64):
    origins, directions = (rays + 0.05 * RNG.normal(size=(4, 30, 3)) for rays in some_rays(30))
    run = functools.partial(traced, jnp.asarray(RNG.normal(size=(2, 30, 3))))
    # What is not batched is the first of the batch.
    given = [
        batch if axis == 0 else jax.tree.map(lambda leaf: leaf[0], batch)
        for batch, axis in zip((small_surfaces(4), origins, directions), axes, strict=True)
    ]
    together, loop = quick_jit(jax.vmap(run, axes))(*given), quick_jit(run)
    for i in range(4):
        turn = [
            jax.tree.map(lambda leaf, i=i: leaf[i], each) if axis == 0 else each
            for each, axis in zip(given, axes, strict=True)
        ]
        alone = loop(*turn)
        assert bool(alone[0][1].any())
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-9, atol=1e-9)


def depths(surface, space, start, parameters):
    pose = space.retract(start, parameters)
    cloud = scan(surface, FEW, pose)
    return jnp.sum((cloud.points - pose.position) * FEW.rays(pose)[1], axis=-1) * cloud.mask


def hessian_and_gradient(run):
    def gradient(parameters):
        slope = jax.jacrev(run)(parameters)
        return slope, slope

    return quick_jit(jax.jacfwd(gradient, has_aux=True))


def test_second_derivatives_of_depths_of_a_ball_in_closed_form(x64):
    """t = -b - sqrt(b^2 - c), b = o . d, c = o . o - r^2."""
    start, space = look_at((0.4, 2.4, 0.5)), SPACES["free"]
    parameters = jnp.asarray(0.02 * RNG.normal(size=9))

    def closed(parameters):
        pose = space.retract(start, parameters)
        o, d = FEW.rays(pose)
        b, c = jnp.sum(o * d, axis=-1), jnp.sum(o * o, axis=-1) - 0.6**2
        hit = b * b > c
        return jnp.where(hit, -b - jnp.sqrt(jnp.where(hit, b * b - c, 1.0)), 0.0)

    run = functools.partial(depths, SDFSurface(Sphere(0.6)), space, start)
    hessian, gradient = hessian_and_gradient(run)(parameters)
    expected = quick_jit(jax.hessian(closed))(parameters)
    misses = ~np.asarray(expected).any(axis=(1, 2))
    assert 2 < misses.sum() < 16
    np.testing.assert_allclose(hessian, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(gradient, quick_jit(jax.jacfwd(closed))(parameters), rtol=1e-8, atol=1e-8)


def test_second_derivatives_of_depths_on_a_grid_against_differences_of_the_gradient(x64):
    start, space, h = look_at((0.4, 2.4, 0.5)), SPACES["free"], 1e-6
    run = hessian_and_gradient(functools.partial(depths, grid_surface(some_bumps(), GRID), space, start))
    parameters, step = jnp.asarray(RNG.normal(size=(2, 9))) * jnp.asarray([[0.02], [1.0]])
    hessian, gradient = run(parameters)
    ahead, behind = (np.asarray(run(parameters + e * step)[1]) for e in (h, -h))
    central = (ahead - behind) / (2 * h)
    error = np.abs(hessian @ step - central).max(axis=1) / (1 + np.abs(central).max(axis=1))
    assert np.asarray(gradient).any(axis=1).sum() > 25
    # At most one ray crosses a border of cells, where the gradient jumps.
    assert np.sort(error)[-2] < 1e-7
