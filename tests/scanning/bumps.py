"""Surfaces and rays to differentiate scans on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from on_grid import nodes

from jaxnbv.geometry.camera import Camera
from jaxnbv.scanning.grid import Grid, GridSurface
from jaxnbv.scanning.sdf import Cuboid, Cylinder, Torus

GRID, SMALL = Grid(60, 1.75), Grid(20, 1.75)
FEW = Camera(height=6, width=6)


def solid():
    bored = Cuboid([0.7, 0.5, 0.6], 0.1) - Cylinder(0.3, 2.0)
    return bored | Torus(0.5, 0.15).rotate([1.0, 1.0, 0.0], 0.8).translate([0.3, 0.5, 0.2])


class Bumps(eqx.Module):
    """|x| - 0.9 and a dozen random waves: smooth and band-limited but for the ball's centre."""

    waves: jax.Array
    phases: jax.Array

    def __call__(self, x):
        return jnp.sqrt(jnp.sum(x**2, axis=-1)) - 0.9 + 0.03 * jnp.sum(jnp.cos(x @ self.waves + self.phases), axis=-1)


def some_bumps(rng):
    return Bumps(jnp.asarray(rng.integers(-3, 4, (3, 12)) * 1.0), jnp.asarray(rng.uniform(0, 2 * np.pi, 12)))


def grid_surface(field, grid):
    return GridSurface.from_values(field(jnp.asarray(nodes(grid.axis))), 0.0, grid)


def small_surfaces(rng, count):
    values = np.stack([some_bumps(rng)(nodes(SMALL.axis)) for _ in range(count)])
    return GridSurface.from_values(values, 0.0, SMALL)


def some_rays(rng, count, spread=0.7):
    origins = rng.normal(size=(count, 3))
    origins *= 2.5 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-spread, spread, (count, 3)) - origins
    return jnp.asarray(origins), jnp.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def rough_values(grid, seed, amplitude):
    """A sphere with smoothed noise, of several cells' wavelength."""
    noise = np.random.default_rng(seed).standard_normal((grid.resolution,) * 3)
    noise = scipy.ndimage.gaussian_filter(noise, 1.2)
    return np.linalg.norm(nodes(grid.axis), axis=-1) - 0.9 + amplitude * noise / noise.std()


def random_rays(seed, count, radius=2.5, spread=1.0):
    rng = np.random.default_rng(seed)
    origins = rng.standard_normal((count, 3))
    origins *= radius / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-spread, spread, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)
