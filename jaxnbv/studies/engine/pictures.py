"""Pictures of a study. The picture of a scene has one small image (tile) per method and view."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D

from jaxnbv.storage.files import make_folder
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.engine.tiles import ScenePicture
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import LINE, draw_border, save_figure

# Inches: size of a tile, and the margins beside and above the grid.
_TILE_SIZE, _SIDE_MARGIN, _TOP_MARGIN = (1.75, 1.95), 0.35, 0.75
# Pictures with one tile per method: largest number of tiles in a row, and smallest width of the picture in tiles.
_MAX_TILES_PER_ROW, _MIN_WIDTH = 5, 3


def write_pictures(
    records: Sequence[Record], study: Study, folder: str | Path, scenes: int = 3, pixels: int = 420
) -> list[Path]:
    """Write pictures `scene_<number>.png` of the first scenes into a folder, and return their paths.

    The pictures show the methods `study.pictured`, or all methods of a record that has none of these. No picture is
    written if `study.scene_picture` returns None.

    - `scenes`: number of pictures; `pixels`: width and height of each tile.
    """
    folder, paths = make_folder(folder), []
    for record in sorted(records, key=lambda record: record["scene"])[:scenes]:
        by_method = record["methods"]
        methods = [method for method in study.pictured if method in by_method] or list(by_method)
        picture = study.scene_picture(record, methods, pixels)
        if picture is not None:
            paths.append(folder / f"scene_{record['scene']:04d}.png")
            with mpl.rc_context(STYLE):
                save_figure(_draw_picture(picture, record, methods), paths[-1])
    return paths


def _draw_picture(picture: ScenePicture, record: Record, methods: Sequence[str]) -> Figure:
    runs = [record["methods"][method] for method in methods]
    columns = picture.columns or tuple(f"view {view + 1}" for view in range(max(len(run["views"]) for run in runs)))
    title, start = f"Scene {record['scene']}: {record['name']}", int(picture.truth is not None)
    if len(columns) == 1:
        return _draw_one_tile_per_method(picture, f"{title}, {columns[0]}", methods)
    figure, grid = _empty_tiles(picture, title, len(methods), start + len(columns))
    for axes, name in zip(grid[0], ("truth", *columns)[1 - start :], strict=True):
        axes.set_title(name, fontsize=9, loc="center", pad=4)
    for row, (method, run) in enumerate(zip(methods, runs, strict=True)):
        if picture.truth is not None:
            picture.truth(grid[row, 0]) if row == 0 else grid[row, 0].axis("off")
        for column, axes in enumerate(grid[row, start:]):
            if picture.columns or column < len(run["views"]):
                picture.tile(axes, method, column)
            else:
                axes.axis("off")
        grid[row, start].set_ylabel(method, fontsize=9, fontweight="bold")
    return figure


def _draw_one_tile_per_method(picture: ScenePicture, title: str, methods: Sequence[str]) -> Figure:
    names = methods if picture.truth is None else ("truth", *methods)
    num_columns = min(len(names), _MAX_TILES_PER_ROW)
    figure, grid = _empty_tiles(picture, title, -(-len(names) // num_columns), num_columns, _MIN_WIDTH)
    tiles = grid.ravel()
    for axes, name in zip(tiles, names, strict=False):
        axes.set_title(name, fontsize=9, loc="center", pad=4)
    if picture.truth is not None:
        picture.truth(tiles[0])
    for axes, method in zip(tiles[len(names) - len(methods) :], methods, strict=False):
        picture.tile(axes, method, 0)
    for axes in tiles[len(names) :]:
        axes.axis("off")
    return figure


def _empty_tiles(
    picture: ScenePicture, title: str, num_rows: int, num_columns: int, min_width: int = 1
) -> tuple[Figure, np.ndarray]:
    """Return a figure with title, caption, legend and colour bar, and its grid of empty tiles."""
    size = (
        max(num_columns, min_width) * _TILE_SIZE[0] + _SIDE_MARGIN * (3 if picture.scale else 1),
        num_rows * _TILE_SIZE[1] + _TOP_MARGIN,
    )
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    grid = figure.subplots(num_rows, num_columns, squeeze=False)
    for axes in grid.ravel():
        draw_border(axes, LINE, 0.8)
    handles = [Line2D([], [], ls="none", label=name, **look) for name, look in picture.marks.items()]
    legend = figure.legend(handles=handles, loc="outside lower left", ncols=max(len(handles), 1), frameon=False)
    legend.set_title(picture.caption, prop=FontProperties(size=8))
    legend.set_alignment("left")
    if picture.scale:
        colours, label = picture.scale
        bar = figure.colorbar(colours, ax=grid, location="right", shrink=min(1.0, 2.0 / num_rows), aspect=25)
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=7, length=2)
        bar.outline.set_visible(False)
    return figure, grid
