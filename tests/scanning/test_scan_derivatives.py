"""Derivatives of hits and normals in the camera's pose, against differences and loops, one by one and in batches.

A scan is smooth in its pose as long as every ray meets the same piece of the surface. It jumps where a ray crosses a
silhouette or an edge between two parts of a solid. On a grid its derivative jumps where a hit crosses a cell's border.
Where a ray grazes the surface the derivative is bounded on purpose. There no derivative equals a difference. Such rays
are left out, and must be few.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bumps import GRID, SMALL, grid_surface, random_rays, small_surfaces, solid, some_bumps

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Sphere

RNG = np.random.default_rng(0)
CAMERA = nbv.Camera(height=24, width=24)
SPACE = nbv.search.FreePoses()


def is_grazing(surface, points, normals, directions):
    """Whether the slope along a ray is near or below its lower bound.

    On a solid the bound is a sine of 0.05, on a grid 0.03 of the spread of f over the corners of the hit's cell.
    """
    if isinstance(surface, nbv.SDFSurface):
        return -np.sum(normals * directions, axis=-1) < 0.055
    position = (points + GRID.half_extent) / GRID.spacing
    cell = np.floor(position).astype(int)
    offsets = np.array(list(np.ndindex(2, 2, 2)))
    corners = np.asarray(surface.values)[tuple(np.moveaxis(cell[..., None, :] + offsets, -1, 0))]

    def f(at):
        return np.sum(corners * np.prod(np.where(offsets, at[..., None, :], 1 - at[..., None, :]), axis=-1), axis=-1)

    slope = (f(position - cell + 1e-4 * directions) - f(position - cell - 1e-4 * directions)) / 2e-4
    return np.abs(slope) < 0.033 * np.ptp(corners, axis=-1)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, None, 0))
@functools.partial(jax.vmap, in_axes=(0, 0, 0, None))
def moves(start, parameters, step, h):
    """Poses at parameters + h step, and their derivatives in h."""
    return jax.jvp(lambda h: SPACE.retract(start, parameters + h * step), (h,), (1.0,))


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def looks(surface, pose, moved):
    """Points, normals, mask and rays, with forward derivatives of points and normals for a pose that moves."""

    def look(pose):
        cloud = nbv.scan(surface, CAMERA, pose)
        return (cloud.points, cloud.normals), (cloud.mask, CAMERA.rays(pose)[1])

    return jax.jvp(look, (pose,), (moved,), has_aux=True)


@pytest.mark.parametrize("name", ["field", "solid"])
def test_scans_as_functions_of_a_pose_against_central_differences(name, x64):
    surface = nbv.SDFSurface(solid()) if name == "solid" else grid_surface(some_bumps(RNG), GRID)
    starts, count, h = nbv.look_at(nbv.geometry.fibonacci_sphere(6, 2.5)), SPACE.num_parameters, 1e-6
    at, step = 0.1 * RNG.normal(size=(6, count)), RNG.normal(size=(6, count))
    values, slopes, (masks, rays) = looks(surface, *moves(starts, at, step, jnp.asarray([0.0, h, -h])))
    points, normals = (np.asarray(value) for value in values)
    masks, hit = np.asarray(masks), np.asarray(masks[0])
    grazing = hit & is_grazing(surface, points[0], normals[0], np.asarray(rays[0]))
    # An edge changes a normal at once. Curvature changes it by at most some hundred times the step.
    is_smooth = (masks == hit).all(axis=0) & (np.abs(normals - normals[0]).max(axis=(0, -1)) < 1e-3)
    if name != "solid":
        cells = np.floor((points + GRID.half_extent) / GRID.spacing)
        is_smooth &= (cells == cells[0]).all(axis=(0, -1))
    assert 0.6 < hit.mean() < 1
    assert (~is_smooth).sum() < 0.005 * hit.sum()
    assert grazing.sum() < 0.02 * hit.sum()
    is_smooth &= hit & ~grazing
    for value, slope in ((points, slopes[0][0]), (normals, slopes[1][0])):
        central = (value[1] - value[2]) / (2 * h)
        error = np.abs(slope - central)[is_smooth] / (1 + np.abs(central[is_smooth]).max(axis=-1, keepdims=True))
        assert error.max() < 1e-5
        assert np.isfinite(slope).all()
        assert not np.asarray(slope)[~hit].any()


@pytest.mark.parametrize("name", ["solid", "grid"])
def test_grazing_and_missed_rays(name):
    """A ball of 0.9. Slopes are bounded and as great as the rays graze. They are exactly zero beside the ball."""
    surface = nbv.SDFSurface(Sphere(0.9)) if name == "solid" else grid_surface(Sphere(0.9), GRID)
    # The ball on the grid is smaller by up to 1.2e-3.
    miss = 0.9 + np.linspace(-4e-3, 1e-3, 200)
    turn = RNG.uniform(0, 2 * np.pi, 200)
    origins = jnp.asarray(np.stack([miss * np.cos(turn), miss * np.sin(turn), 0 * miss - 2.5], axis=1), jnp.float32)
    directions = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0]), (200, 3))

    @jax.jit
    def trace(origin, direction):
        hits = surface.trace(origin[None], direction[None])
        return (hits.points[0], hits.normals[0]), hits.mask[0]

    forward, mask = jax.jit(jax.vmap(jax.jacfwd(trace, (0, 1), has_aux=True)))(origins, directions)
    reverse, _ = jax.jit(jax.vmap(jax.jacrev(trace, (0, 1), has_aux=True)))(origins, directions)
    mask = np.asarray(mask)
    assert 0.5 < mask.mean() < 0.9
    # |dt| is at most 1 / 0.05 or 1 / 0.03 times the motion of the origin, or of the hit, which is at most 4 away.
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


@jax.jit
def traced(weights, surface, origins, directions):
    def total(values, origins, directions):
        hits = nbv.scanning.GridSurface(values, surface.distance, SMALL).trace(origins, directions)
        return jnp.sum(weights[0] * hits.points) + jnp.sum(weights[1] * hits.normals), hits.mask

    return jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)(surface.values, origins, directions)


@pytest.mark.parametrize("axes", [(0, 0, None), (None, 0, None)])
def test_every_way_to_batch_fields_and_rays_equals_a_loop(axes, x64):
    origins, directions = (
        rays + 0.05 * RNG.normal(size=(3, 30, 3)) for rays in random_rays(RNG, 30, spread=0.7, dtype=float)
    )
    weights = jnp.asarray(RNG.normal(size=(2, 30, 3)))
    # Arguments without a batch axis are the first of the batch.
    arguments = [
        batch if axis == 0 else jax.tree.map(lambda leaf: leaf[0], batch)
        for batch, axis in zip((small_surfaces(RNG, 3), origins, directions), axes, strict=True)
    ]
    together = jax.jit(jax.vmap(traced, (None, *axes)))(weights, *arguments)
    for i in range(3):
        turn = [
            jax.tree.map(lambda leaf, i=i: leaf[i], each) if axis == 0 else each
            for each, axis in zip(arguments, axes, strict=True)
        ]
        alone = traced(weights, *turn)
        assert bool(alone[0][1].any())
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-9, atol=1e-9)
