"""Surfaces and rays for derivatives of scans."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from on_grid import nodes

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Cylinder, Torus

GRID, SMALL = nbv.Grid(60, 1.75), nbv.Grid(20, 1.75)
FEW = nbv.Camera(height=6, width=6)


def solid():
    bored = Cuboid([0.7, 0.5, 0.6], 0.1) - Cylinder(0.3, 2.0)
    return bored | Torus(0.5, 0.15).rotate([1.0, 1.0, 0.0], 0.8).translate([0.3, 0.5, 0.2])


class Bumps(eqx.Module):
    """|x| - 0.9 and a dozen random waves: smooth and band-limited except at the ball's centre."""

    waves: jax.Array
    phases: jax.Array

    def __call__(self, x):
        return jnp.sqrt(jnp.sum(x**2, axis=-1)) - 0.9 + 0.03 * jnp.sum(jnp.cos(x @ self.waves + self.phases), axis=-1)


def some_bumps(rng):
    return Bumps(jnp.asarray(rng.integers(-3, 4, (3, 12)) * 1.0), jnp.asarray(rng.uniform(0, 2 * np.pi, 12)))


def grid_surface(field, grid):
    return nbv.scanning.GridSurface.from_values(field(jnp.asarray(nodes(grid.axis))), 0.0, grid)


def small_surfaces(rng, count):
    values = np.stack([some_bumps(rng)(nodes(SMALL.axis)) for _ in range(count)])
    return nbv.scanning.GridSurface.from_values(values, 0.0, SMALL)


def rough_values(grid, seed, amplitude):
    """A sphere with smoothed noise whose wavelength is several cells."""
    noise = np.random.default_rng(seed).standard_normal((grid.resolution,) * 3)
    noise = scipy.ndimage.gaussian_filter(noise, 1.2)
    return np.linalg.norm(nodes(grid.axis), axis=-1) - 0.9 + amplitude * noise / noise.std()


def random_rays(rng, count, radius=2.5, spread=1.0, dtype=np.float32):
    """Rays from points on a sphere towards points in a cube. `rng` may be a seed."""
    rng = np.random.default_rng(rng)
    origins = rng.standard_normal((count, 3))
    origins *= radius / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-spread, spread, (count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(dtype), directions.astype(dtype)


def sphere_hit(o, d, radius):
    """Distance along rays to a ball about the origin, from outside or within, in float64. Infinite for a miss."""
    o, d = o.astype(float), d.astype(float)
    b = np.sum(o * d, axis=1)
    squared = b**2 - np.sum(o**2, axis=1) + radius**2
    root = np.sqrt(np.maximum(squared, 0))
    t = np.where(-b - root > 0, -b - root, -b + root)
    return np.where((squared > 0) & (t > 0), t, np.inf)


def box_hit(o, d, half):
    """Distance along rays to a box about the origin, and the outward normal there."""
    o, d = o.astype(float), d.astype(float)
    a, b = (-half - o) / d, (half - o) / d
    near, far = np.minimum(a, b), np.maximum(a, b)
    enter, leave = near.max(axis=1), far.min(axis=1)
    t = np.where(enter > 0, enter, leave)
    normal = -np.sign(d) * (np.arange(3) == near.argmax(axis=1)[:, None])
    return np.where((enter < leave) & (t > 0), t, np.inf), normal
