"""Stacking of scenes that have the same structure, so that one compiled program scans all of them."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from jaxnbv.checks import check_type, require, short_text
from jaxnbv.scanning.mesh_files import as_surface
from jaxnbv.scanning.scanner import Surface
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.scanning.sphere_tracing import SDFSurface


def scene_batch(scenes: Any, count: int) -> Surface:
    """Stack scenes into one surface whose arrays have a leading axis of length `count`.

    - `scenes`: a list of scenes, or one scene whose arrays already have this leading axis.

    **Raises:** `ValueError` if JAX cannot trace a scene, there are not `count` scenes, or their structures differ.
    """
    if not isinstance(scenes, Sequence):
        batch = _traceable(scenes, "the scene")
        shapes = [np.shape(leaf) for leaf in jax.tree.leaves(eqx.filter(batch, eqx.is_array))]
        bad_shapes = [shape for shape in shapes if shape[:1] != (count,)]
        require(
            not bad_shapes,
            f"there are {count} keys, but the scenes hold an array of shape {bad_shapes[:1]}, which needs a leading "
            f"axis of {count}: give a list with a scene for each key, [scene] * {count} to repeat one",
        )
        return batch
    require(len(scenes) == count, f"there are {len(scenes)} scenes for {count} keys: give a scene for each key")
    surfaces = [_traceable(scene, f"scene {index}") for index, scene in enumerate(scenes)]
    for index, surface in enumerate(surfaces):
        require(
            _structure(surface) == _structure(surfaces[0]),
            f"scene {index} ({_kind(surface)}) has another structure or other shapes of arrays than scene 0 "
            f"({_kind(surfaces[0])}), but one program needs the same for all: sample them all on one grid, with "
            "nbv.scanning.GridSurface.from_values",
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves) if eqx.is_array(leaves[0]) else leaves[0], *surfaces)


def _traceable(scene: Any, name: str) -> Surface:
    is_mesh = isinstance(scene, trimesh.Geometry) or (isinstance(scene, Surface) and not scene.in_jit)
    require(
        not is_mesh,
        f"{name} is {short_text(scene)}, which a compiled program cannot scan: give it as a solid, "
        "nbv.sdf.solid_of_mesh(mesh.vertices, mesh.faces, cubic=True), or call simulate for each",
    )
    check_type(scene, Surface | SignedDistance, name)
    return as_surface(scene)


def _structure(surface: Surface) -> Any:
    """Return what surfaces must have in common to be stacked: structure, array shapes and static values."""
    arrays, rest = eqx.partition(surface, eqx.is_array)
    return jax.tree.structure(arrays), list(map(np.shape, jax.tree.leaves(arrays))), jax.tree.leaves(rest)


def _kind(surface: Surface) -> str:
    return type(surface.sdf if isinstance(surface, SDFSurface) else surface).__name__
