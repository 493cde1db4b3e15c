"""Pictures of a study: for each scene a grid of tiles, a row a method and a column a view, beside the truth."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D

from jaxnbv.scanning import TriangleMesh
from jaxnbv.storage.files import make_folder
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.study import Study
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.layout import framed
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.render import Still
from jaxnbv.viz.style import GREY, LINE, save_figure

PIXELS = 420
RIGHT = "#00734f"
# Inches of a tile, and of what stands beside and above all of them.
_TILE, _BESIDE, _ABOVE = (1.75, 1.95), 0.35, 0.75
# A still is coloured at vertices: no triangle may be larger than what its colours vary over. Half of what it spans.
_EDGE, _REACH = 0.05, 1.6


class Tiles(NamedTuple):
    """How a study draws a scene.

    - `caption`: beneath all.
    - `tile`: fills the tile of a method at a column, given its axes.
    - `truth`: fills the tile of the truth, which stands before the first row; None for none.
    - `columns`: what the tiles of a method are; "" for its views.
    - `marks`: a legend, the look of a `Line2D` by name; `scale`: a bar of colours, and what they mean.
    """

    caption: str
    tile: Callable[[Axes, str, int], None]
    truth: Callable[[Axes], object] | None = None
    columns: tuple[str, ...] = ()
    marks: Mapping[str, Mapping[str, Any]] = {}
    scale: tuple[ScalarMappable, str] | None = None


# Of a scene's record, the methods that are shown, and the pixels along a side of a tile.
Draw = Callable[[Any, Record, Sequence[str], int], Tiles]


def write_pictures(
    records: Sequence[Record], study: Study, folder: str | Path, draw: Draw, scenes: int = 3, pixels: int = PIXELS
) -> list[Path]:
    """Write `scene_<number>.png` for the first scenes, not picked ones, into a folder; return the paths. Methods are
    those of the study that are `pictured`, or all that the records hold."""
    folder, paths = make_folder(folder), []
    for record in sorted(records, key=lambda record: record["scene"])[:scenes]:
        held = record["methods"]
        methods = [method for method in study.pictured if method in held] or list(held)
        paths.append(folder / f"scene_{record['scene']:04d}.png")
        with mpl.rc_context(STYLE):
            save_figure(_drawn(draw(study, record, methods, pixels), record, methods), paths[-1])
    return paths


def _drawn(tiles: Tiles, record: Record, methods: Sequence[str]) -> Figure:
    runs = [record["methods"][method] for method in methods]
    columns = tiles.columns or tuple(f"view {view + 1}" for view in range(max(len(run["views"]) for run in runs)))
    start, tall = int(tiles.truth is not None), len(methods)
    wide = start + len(columns)
    size = wide * _TILE[0] + _BESIDE * (3 if tiles.scale else 1), tall * _TILE[1] + _ABOVE
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(f"Scene {record['scene']}: {record['name']}", x=0.01, ha="left", fontsize=10, fontweight="bold")
    grid = figure.subplots(tall, wide, squeeze=False)
    for axes, title in zip(grid[0], ("truth", *columns)[1 - start :], strict=True):
        axes.set_title(title, fontsize=9, loc="center", pad=4)
    for row, (method, run) in enumerate(zip(methods, runs, strict=True)):
        for axes in grid[row]:
            framed(axes, LINE, 0.8)
        if tiles.truth is not None:
            tiles.truth(grid[row, 0]) if row == 0 else grid[row, 0].axis("off")
        for column, axes in enumerate(grid[row, start:]):
            if tiles.columns or column < len(run["views"]):
                tiles.tile(axes, method, column)
            else:
                axes.axis("off")
        grid[row, start].set_ylabel(method, fontsize=9, fontweight="bold")
    handles = [Line2D([], [], ls="none", label=name, **look) for name, look in tiles.marks.items()]
    legend = figure.legend(handles=handles, loc="outside lower left", ncols=max(len(handles), 1), frameon=False)
    legend.set_title(tiles.caption, prop=FontProperties(size=8))
    legend.set_alignment("left")
    if tiles.scale:
        colours, label = tiles.scale
        bar = figure.colorbar(colours, ax=grid, location="right", shrink=min(1.0, 2.0 / tall), aspect=25)
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=7, length=2)
        bar.outline.set_visible(False)
    return figure


def say(axes: Axes, text: str, right: bool = False) -> None:
    """A line beneath a tile, which stands out where it is right."""
    colour, weight = (RIGHT, "bold") if right else (GREY, "normal")
    axes.set_xlabel(f"{'✓ ' if right else ''}{text}", fontsize=9, color=colour, fontweight=weight)


def across(study: Study, record: Record) -> Float[np.ndarray, "3"]:
    """Where to look from to see what the first view, which all methods share, does not show: from across the object,
    and from above."""
    position = np.asarray(study.candidates.poses().position[record["first"]], np.float64)
    away = -position[[0, 2]]
    length = np.linalg.norm(away)
    away = away / length if length > 1e-3 else np.array([0.6, 0.8])
    return np.array([away[0], 0.55, away[1]])


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
