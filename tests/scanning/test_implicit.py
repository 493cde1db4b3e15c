"""The implicit rule for depths against Optimistix and by hand, and its second derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from bumps import FEW, GRID, grid_surface, random_rays, solid, some_bumps
from jax.scipy.ndimage import map_coordinates
from on_grid import nodes

import jaxnbv as nbv
from jaxnbv.scanning.scanner import implicit_depth
from jaxnbv.scanning.sdf import Sphere

RNG = np.random.default_rng(0)


class Along(eqx.Module):
    """A function along rays, differentiable in all of its arguments."""

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
    """Roots by Newton's method, differentiated by Optimistix's implicit adjoint."""

    def root(function, origin, direction, near):
        solver = optx.Newton(rtol=1e-13, atol=1e-13)
        return optx.root_find(
            lambda t, ray: ray[0]((ray[1] + t * ray[2])[None])[0], solver, near, (function, origin, direction)
        ).value

    return jax.vmap(root, (None, 0, 0, 0))(along.function, along.origins, along.directions, near)


@pytest.mark.parametrize("name", ["solid", "grid"])
def test_gradients_of_depths_equal_those_of_optimistix(name, x64):
    bumps = some_bumps(RNG)
    function = solid() if name == "solid" else Interpolant(bumps(jnp.asarray(nodes(GRID.axis))))
    surface = nbv.SDFSurface(solid()) if name == "solid" else grid_surface(bumps, GRID)
    origins, directions = map(jnp.asarray, random_rays(RNG, 60, spread=0.7, dtype=float))
    hits = surface.trace(origins, directions)
    use = np.asarray(hits.mask) & (-np.sum(hits.normals * directions, axis=1) > 0.2)
    origins, directions = origins[use], directions[use]
    near = jnp.sum((hits.points[use] - origins) * directions, axis=1)
    along = Along(function, origins, directions)
    weights = jnp.asarray(RNG.normal(size=len(near)))

    def theirs(along):
        depth = optimistix_depth(along, near)
        return weights @ depth, depth

    (_, depth), expected = eqx.filter_jit(eqx.filter_value_and_grad(theirs, has_aux=True))(along)

    def ours(along):
        if name == "solid":
            traced = nbv.SDFSurface(along.function)
        else:
            traced = nbv.scanning.GridSurface(along.function.values, surface.distance, GRID)
        points = traced.trace(along.origins, along.directions).points
        offset, square = points - along.origins, jnp.sum(along.directions**2, axis=1)
        return weights @ (jnp.sum(offset * along.directions, axis=1) / square)

    assert len(near) > 30
    value, gradient = eqx.filter_jit(eqx.filter_value_and_grad(ours))(along)
    np.testing.assert_allclose(value, weights @ depth, rtol=1e-10)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8)


def test_rule_on_straight_functions_by_hand():
    """f = s t - c has dt/dc = 1 / s, with |s| at least 0.1 and its sign kept. A miss has no derivative."""

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


def depths(surface, space, start, parameters):
    pose = space.retract(start, parameters)
    cloud = nbv.scan(surface, FEW, pose)
    return jnp.sum((cloud.points - pose.position) * FEW.rays(pose)[1], axis=-1) * cloud.mask


def hessian_and_gradient(run):
    def gradient(parameters):
        slope = jax.jacrev(run)(parameters)
        return slope, slope

    return jax.jit(jax.jacfwd(gradient, has_aux=True))


def test_second_derivatives_of_depths_of_a_ball_in_closed_form(x64):
    """t = -b - sqrt(b^2 - c), b = o . d, c = o . o - r^2."""
    start, space = nbv.look_at((0.4, 2.4, 0.5)), nbv.search.FreePoses()
    parameters = jnp.asarray(0.02 * RNG.normal(size=9))

    def closed(parameters):
        pose = space.retract(start, parameters)
        o, d = FEW.rays(pose)
        b, c = jnp.sum(o * d, axis=-1), jnp.sum(o * o, axis=-1) - 0.6**2
        hit = b * b > c
        return jnp.where(hit, -b - jnp.sqrt(jnp.where(hit, b * b - c, 1.0)), 0.0)

    run = functools.partial(depths, nbv.SDFSurface(Sphere(0.6)), space, start)
    hessian, gradient = hessian_and_gradient(run)(parameters)
    expected = jax.jit(jax.hessian(closed))(parameters)
    misses = ~np.asarray(expected).any(axis=(1, 2))
    assert 2 < misses.sum() < 16
    np.testing.assert_allclose(hessian, expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(gradient, jax.jit(jax.jacfwd(closed))(parameters), rtol=1e-8, atol=1e-8)
