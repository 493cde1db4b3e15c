"""A bank of known shapes, the components of the mixture prior."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Int, UInt8

from jaxnbv.checks import InputError, check_type, checked, require, short_text
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.programs import program
from jaxnbv.scanning.sdf import Scaled, SignedDistance
from jaxnbv.surfaces.look_alikes import warn_of_look_alikes
from jaxnbv.surfaces.mesh_shapes import as_tuple, mesh_paths, shapes_of_meshes

NUM_EXTREMES, _START_RADIUS, _NUM_STRIDES, _MAX_DISTANCE = 128, 4.0, 40, 0.01
_MAX_NAME_BYTES = 64
# Lengths, in metres, of the units that meshes may use.
_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


class Shape(NamedTuple):
    """One shape of a bank, or several along a leading axis.

    - `extremes`: points on the surface. In every direction, one of these is nearly the farthest point of the shape.
    """

    solid: SignedDistance
    extremes: Float[Array, "*k p 3"]


class ShapeBank(eqx.Module):
    """Known shapes, each centred in its own frame. Shapes of the same kind are oriented alike.

    - `solids`: all shapes as one batch, whose arrays have a leading axis of shapes; None for an empty bank.
    - `extremes`: points on the surface of each shape, see `Shape`.
    - `codes`: the names in UTF-8. They are an array, so that compiled programs do not depend on the names.
    - `from_mesh`: (k, 4, 4) similarity transforms from the coordinates of each mesh to the coordinates of its shape;
      None if the shapes do not come from meshes.
    - `is_true_size`: whether the shapes are as large as the real objects, so that placements do not scale them.

    **Raises:** `ValueError` if the arrays have different numbers of rows.
    """

    solids: SignedDistance | None
    extremes: Float[Array, "k p 3"]
    codes: UInt8[Array, "k c"]
    from_mesh: Float[Array, "k 4 4"] | None = None
    is_true_size: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_type(self.solids, SignedDistance | None, "the bank's solids")
        rows = {
            jnp.shape(leaf)[:1] for leaf in jax.tree.leaves((self.solids, self.extremes, self.codes, self.from_mesh))
        }
        require(
            len(rows) == 1,
            f"the arrays of the bank have {sorted(rows)} rows: make it with ShapeBank.of or ShapeBank.from_meshes",
        )

    @classmethod
    def of(
        cls, solids: Sequence[SignedDistance], names: Sequence[str] | None = None, is_true_size: bool = False
    ) -> "ShapeBank":
        """Make a bank of solids of one type, whose signed distances are evaluated exactly, without a grid.

        - `names`: by default the indices.
        - `is_true_size`: whether the solids are as large as the real objects, see `from_meshes`.

        **Raises:** `ValueError` for entries that are not solids, for solids of several types, or if the number of names
        differs from the number of solids.
        """
        solids = as_tuple(solids, "the bank's solids")
        for index, solid in enumerate(solids):
            check_type(solid, SignedDistance, f"solid {index} of the bank")
        names = tuple(map(str, range(len(solids)))) if names is None else _as_names(names)
        require(len(names) == len(solids), f"there are {len(names)} names for {len(solids)} solids: give one for each")
        if not solids:
            return cls(None, jnp.zeros((0, NUM_EXTREMES, 3)), encode_names(names))
        kinds = {jax.tree.structure(solid): index for index, solid in reversed(list(enumerate(solids)))}
        require(
            len(kinds) == 1,
            f"the bank's solids are of {len(kinds)} kinds, such as numbers {sorted(kinds.values())[:2]}: give solids "
            "of one kind, or meshes of them (nbv.mesh_from_sdf) to ShapeBank.from_meshes",
        )
        joined = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *solids)
        from_mesh = jnp.tile(jnp.eye(4), (len(solids), 1, 1)) if is_true_size else None
        return cls(joined, _extremes(joined), encode_names(names), from_mesh, is_true_size)

    @classmethod
    @checked
    def from_meshes(
        cls,
        meshes: str | Path | Sequence[str | Path | trimesh.Trimesh],
        resolution: int = 64,
        sheet: float = 0.05,
        names: Sequence[str] | None = None,
        progress: bool = True,
        scale: float | str | None = None,
        up: str = "y",
    ) -> "ShapeBank":
        """Make a bank of centred meshes, which are stored as signed distances on grids.

        Triangle soups and open meshes also work. The grids are cached in the user's cache folder.

        - `meshes`: a list of files and `trimesh` meshes, or a folder, which is searched with its subfolders.
        - `resolution`: nodes along the longest side.
        - `sheet`: thickness given to faces that have the outside on both sides, in units in which the mesh's longest
          side is 2.5.
        - `names`: by default each file's path within the folder, a listed file's name, or a `trimesh` mesh's index.
        - `scale`: the length of the meshes' unit in world units, for parts at true size. Give a number, or one of "m",
          "cm", "mm", "in" and "ft" if the world is in metres. Use None for examples of categories, whose size does not
          matter. Their longest side then becomes 2.5.
        - `up`: the upward axis of the meshes, see `Frame`.

        A `UserWarning` names each unusable mesh, which is left out, and with `scale` also each pair of equal parts.

        **Raises:** `ValueError` if no mesh can be used, if the number of names differs from the number of meshes, for
        numbers out of range, or for an unknown unit.
        """
        factor = None if scale is None else _metres(scale)
        require(resolution >= 8, f"the resolution is {resolution}; it must be at least 8")
        require(0 < sheet < 1, f"sheets are {sheet} thick; give scene units, above 0 and below 1")
        paths = mesh_paths(meshes)
        if names is None:
            folder = Path(meshes) if isinstance(meshes, str | Path) else None
            files = [
                Path(str(index)) if isinstance(path, trimesh.Trimesh) else path for index, path in enumerate(paths)
            ]
            names = [path.stem if folder is None else str(path.relative_to(folder).with_suffix("")) for path in files]
        names = _as_names(names)
        require(len(names) == len(paths), f"there are {len(names)} names for {len(paths)} meshes: give one for each")
        shapes, rows = shapes_of_meshes(paths, resolution, sheet, NUM_EXTREMES, up, progress)
        joined, extremes, from_mesh = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *shapes)
        bank = cls(joined, extremes, encode_names([names[index] for index in rows]), from_mesh)
        if factor is None:
            return bank
        sizes = factor / jnp.cbrt(jnp.linalg.det(from_mesh[:, :3, :3]))
        warn_of_look_alikes(shapes, bank.names, np.asarray(sizes), stacklevel=3)
        return dataclasses.replace(bank, is_true_size=True)._resize(sizes)

    def in_scene(self, frame: Frame) -> "ShapeBank":
        """Return a copy with true sizes, if the bank has them, converted from world to scene units."""
        return self._resize(jnp.full(len(self), frame.scale)) if self.is_true_size else self

    def _resize(self, factors: Float[Array, " k"]) -> "ShapeBank":
        if self.solids is None:
            return self
        if isinstance(self.solids, Scaled):
            larger = eqx.tree_at(lambda solids: solids.factor, self.solids, factors * self.solids.factor)
        else:
            larger = jax.vmap(Scaled)(self.solids, factors)
        from_mesh = None
        if self.from_mesh is not None:
            from_mesh = self.from_mesh.at[:, :3].multiply(factors[:, None, None])
        return dataclasses.replace(
            self, solids=larger, extremes=factors[:, None, None] * self.extremes, from_mesh=from_mesh
        )

    @property
    def shapes(self) -> Shape:
        """All shapes as one batch. The bank must not be empty."""
        assert self.solids is not None
        return Shape(self.solids, self.extremes)

    def shape(self, index: Int[Array, "*s"]) -> Shape:
        """Return the shape at an index, or a batch of shapes for an array of indices."""
        return jax.tree.map(lambda rows: rows[index], self.shapes)

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all shapes."""
        return tuple(bytes(code).rstrip(b"\0").decode(errors="ignore") for code in np.asarray(self.codes))

    def select(self, indices: Sequence[int]) -> "ShapeBank":
        """Return a bank of the shapes at these indices.

        **Raises:** `ValueError` for an index out of range.
        """
        indices = as_tuple(indices, "the indices")
        for index in indices:
            check_type(index, int, "an index of the bank")
            require(0 <= index < len(self), f"the bank has {len(self)} shapes; there is no number {index}")
        rows = np.asarray(indices, int)
        solids = jax.tree.map(lambda leaf: leaf[rows], self.solids) if len(rows) else None
        from_mesh = None if self.from_mesh is None else self.from_mesh[rows]
        return ShapeBank(solids, self.extremes[rows], self.codes[rows], from_mesh, self.is_true_size)


def _metres(scale: float | str) -> float:
    """Return the length of a named unit in metres. A number is returned unchanged."""
    if isinstance(scale, str):
        require(
            scale in _METRES, f"the unit is {scale!r}: give one of {', '.join(_METRES)}, or its length in the world"
        )
        return _METRES[scale]
    if not (0 < scale < np.inf):
        raise InputError(f"the scale is {short_text(scale)}: give the length of the meshes' unit in the world, above 0")
    return float(scale)


def _as_names(names: Sequence[str]) -> tuple[str, ...]:
    strings = as_tuple(names, "the names")
    for name in strings:
        check_type(name, str, "a name of a shape")
    return strings


def encode_names(names: Sequence[str]) -> UInt8[Array, "k c"]:
    """Encode names as rows of `ShapeBank.codes`, cut after 64 bytes."""
    rows = [name.encode()[:_MAX_NAME_BYTES].ljust(_MAX_NAME_BYTES, b"\0") for name in names]
    return jnp.asarray(np.frombuffer(b"".join(rows), np.uint8).reshape(-1, _MAX_NAME_BYTES))


@program
def _extremes(solids: SignedDistance) -> Float[Array, "k p 3"]:
    """Return points on each solid's surface, which Newton steps on the distance reach from a large sphere."""
    start = fibonacci_sphere(NUM_EXTREMES, _START_RADIUS)

    def of_solid(solid):
        def stride(points, _):
            distance, gradient = values_and_gradients(solid, points)
            square = jnp.sum(gradient**2, axis=-1)
            return points - (distance / jnp.where(square > 0, square, 1.0))[:, None] * gradient, None

        points = jax.lax.scan(stride, start, length=_NUM_STRIDES)[0]
        # If a solid gives only a bound of the distance, points may miss the surface. A point that hit it replaces them.
        is_on_surface = jnp.abs(solid(points)) < _MAX_DISTANCE
        return jnp.where(is_on_surface[:, None], points, points[jnp.argmax(is_on_surface)])

    return jax.lax.map(of_solid, solids, batch_size=16)


def values_and_gradients(
    function: Callable[[Float[Array, "n 3"]], Float[Array, " n"]], points: Float[Array, "n 3"]
) -> tuple[Float[Array, " n"], Float[Array, "n 3"]]:
    """Return a function's values and gradients at points. Each value must depend on one point alone."""
    values, derivative = jax.linearize(function, points)
    columns = [derivative(jnp.broadcast_to(direction, points.shape)) for direction in jnp.eye(3, dtype=points.dtype)]
    return values, jnp.stack(columns, axis=-1)
