"""Pictures of a study: a grid of tiles a scene, such as a row a method and a column a view."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D

from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.scanning import TriangleMesh
from jaxnbv.storage.files import make_folder
from jaxnbv.studies.engine.measures import Record
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.layout import framed
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.render import Still
from jaxnbv.viz.style import LINE, save_figure

# Inches of a tile, and of what stands beside and above all of them.
_TILE, _BESIDE, _ABOVE = (1.75, 1.95), 0.35, 0.75
# A still is coloured at vertices: no triangle may be larger than what its colours vary over. Half of what it spans.
_EDGE, _REACH = 0.05, 1.6
# Places to look from, their distance, and how far from a point it still shows.
_PLACES, _DISTANCE, _NEAR = 80, 11.0, 0.05


class Grid(NamedTuple):
    """Tiles in rows and columns under a title and a caption.

    - `draw`: fills the tile at a row and a column, given its axes.
    - `named`: the column beside which the rows' names stand.
    - `marks`: a legend, the look of a `Line2D` by name; `scale`: a bar of colours, and what they mean.
    """

    title: str
    caption: str
    rows: Sequence[str]
    columns: Sequence[str]
    draw: Callable[[Axes, int, int], None]
    marks: Mapping[str, Mapping[str, Any]] = {}
    scale: tuple[ScalarMappable, str] | None = None
    named: int = 0


def write_grids(records: Sequence[Record], folder: str | Path, name: str, make: Callable[[Record], Grid]) -> list[Path]:
    """Write `<name>_<scene>.png` for each record into a folder; return the paths."""
    folder, paths = make_folder(folder), []
    with mpl.rc_context(STYLE):
        for record in records:
            paths.append(folder / f"{name}_{record['scene']:03d}.png")
            save_figure(_drawn(make(record)), paths[-1])
    return paths


def first_scenes(records: Sequence[Record], count: int) -> list[Record]:
    """Not picked ones."""
    return sorted(records, key=lambda record: record["scene"])[:count]


def _drawn(grid: Grid) -> Figure:
    tall, wide = len(grid.rows), len(grid.columns)
    size = wide * _TILE[0] + _BESIDE * (3 if grid.scale else 1), tall * _TILE[1] + _ABOVE
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(grid.title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    tiles = figure.subplots(tall, wide, squeeze=False)
    for row, line in enumerate(tiles):
        for column, axes in enumerate(line):
            framed(axes, LINE, 0.8)
            grid.draw(axes, row, column)
            if row == 0:
                axes.set_title(grid.columns[column], fontsize=9, loc="center", pad=4)
        line[grid.named].set_ylabel(grid.rows[row], fontsize=9, fontweight="bold")
    handles = [Line2D([], [], ls="none", label=name, **look) for name, look in grid.marks.items()]
    legend = figure.legend(handles=handles, loc="outside lower left", ncols=max(len(handles), 1), frameon=False)
    legend.set_title(grid.caption, prop=FontProperties(size=8))
    legend.set_alignment("left")
    if grid.scale:
        colours, label = grid.scale
        bar = figure.colorbar(colours, ax=tiles, location="right", shrink=min(1.0, 2.0 / tall), aspect=25)
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=7, length=2)
        bar.outline.set_visible(False)
    return figure


def still_of(
    mesh: TriangleMesh,
    eye: Float[np.ndarray, "3"],
    size: int,
    value: Callable[[np.ndarray], Float[np.ndarray, " n"]] | None = None,
    norm: LogNorm | None = None,
) -> Still:
    """A picture of a mesh, plain or coloured by a positive value at its points."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _EDGE, max_iter=12)
    fine = trimesh.Trimesh(vertices, faces)
    values = np.ones(len(fine.vertices)) if value is None else np.maximum(value(fine.vertices), 1e-6)
    surface = MeanSurface(np.asarray(fine.vertices), np.asarray(fine.faces), np.asarray(fine.vertex_normals), values)
    still = Still(eye, surface, size, _REACH)
    still.paint(norm)
    return still


def places() -> Float[np.ndarray, "n 3"]:
    """Where a person may stand to look: all around, from a little below to well above."""
    around = np.asarray(fibonacci_sphere(_PLACES, _DISTANCE), np.float64)
    return around[(around[:, 1] > -0.2 * _DISTANCE) & (around[:, 1] < 0.7 * _DISTANCE)]


def shows_from(
    mesh: TriangleMesh, eyes: Float[np.ndarray, "e 3"], points: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "e n"]:
    """Whether what is first hit from a place in the direction of a point of the mesh lies near it."""
    away = points[None] - eyes[:, None]
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    hits = mesh.trace(np.broadcast_to(eyes[:, None], away.shape).reshape(-1, 3), away.reshape(-1, 3))
    near = np.linalg.norm(np.asarray(hits.points).reshape(away.shape) - points, axis=-1) < _NEAR
    return near & np.asarray(hits.mask).reshape(near.shape)


def draw_on(
    axes: Axes,
    still: Still,
    points: Float[np.ndarray, "n 3"],
    colours: Float[np.ndarray, "n channels"],
) -> None:
    """The points that a still's surface does not hide, over it, the nearest last."""
    axes.imshow(still.image, interpolation="antialiased", zorder=1)
    pixels, in_front = still.project(points)
    depth = (points - np.asarray(still.pose.position)) @ np.asarray(still.pose.forward)
    order = np.argsort(-depth)
    order = order[in_front[order]]
    axes.scatter(pixels[order, 0], pixels[order, 1], s=2.5, c=colours[order], linewidths=0, zorder=2)
    shown = np.argwhere(still.image[..., 3] > 0)
    middle, half = 0.5 * (shown.min(axis=0) + shown.max(axis=0)), 0.55 * np.ptp(shown, axis=0).max()
    axes.set(xlim=middle[1] + [-half, half], ylim=middle[0] + [half, -half])
