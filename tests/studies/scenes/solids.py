"""Procedural solids as meshes, for tests of their shape."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from skimage.measure import marching_cubes

NODES, REACH = 90, 1.3


@eqx.filter_jit
def on_grid(solid):
    axis = jnp.linspace(-REACH, REACH, NODES)
    y, z = jnp.meshgrid(axis, axis, indexing="ij")
    return jax.lax.map(lambda x: solid(jnp.stack([jnp.full_like(y, x), y, z], axis=-1)), axis)


def mesh_of(solid):
    spacing = 2 * REACH / (NODES - 1)
    vertices, faces, _, _ = marching_cubes(
        np.array(on_grid(solid)), 0.0, spacing=(spacing,) * 3, gradient_direction="descent"
    )
    return trimesh.Trimesh(vertices - REACH, faces, process=False)


def check_whole(mesh):
    """Check that a mesh is in one piece, except for small cavities between primitives, which are invisible and have
    negative volume."""
    volumes = [piece.volume for piece in mesh.split(only_watertight=False)]
    assert sum(volume > 0 for volume in volumes) == 1
    assert sum(abs(volume) for volume in volumes if volume < 0) < 0.01 * max(volumes)


def check_fills_its_box(mesh):
    low, high = mesh.bounds
    np.testing.assert_allclose(low + high, 0.0, atol=0.025)
    np.testing.assert_allclose(np.max(high - low), 2.5, rtol=0.01)


def thinnest(solid):
    """The least thickness of the solid's primitives."""
    halves = []
    for k in np.flatnonzero(np.asarray(solid.labels) >= 0):
        half = np.asarray(solid.half_size[k])
        if solid.revolved[k] and solid.radius[k] == 0:
            # The thinner end of a cone.
            half = half[:2] - [abs(float(solid.slant[k])) * half[1], 0.0]
        halves.append(half.min())
    return 2 * min(halves)
