"""Picture of a scene as a grid of small images (tiles), and functions that draw the tiles."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm

from jaxnbv.scanning import TriangleMesh
from jaxnbv.studies.engine.measures import Record
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.render import Still
from jaxnbv.viz.style import GREY

_CORRECT_COLOUR = "#00734f"
# Colour scale of distances to a true surface (scene units), from the sensor noise to 1/5 of the object's size.
ERRORS = LogNorm(0.01, 0.5)
# In scene units: longest edge of the triangles in a rendered image (short, because colours are given at vertices), and
# radius of the ball that the image shows.
_MAX_EDGE, _IMAGE_RADIUS = 0.05, 1.6


class ScenePicture(NamedTuple):
    """The picture of a scene: a grid of small images (tiles), with one row per method.

    - `caption`: text below the picture.
    - `tile`: function that draws the tile of a method (name) and a column (index) on axes.
    - `truth`: function that draws the tile of the true object, left of the first row; None for no such tile.
    - `columns`: titles of the columns; empty for one column per view.
    - `marks`: entries of the legend: for each label, the keyword arguments of its `Line2D`.
    - `scale`: colour scale of the colour bar, and its label; None for no colour bar.
    """

    caption: str
    tile: Callable[[Axes, str, int], None]
    truth: Callable[[Axes], object] | None = None
    columns: tuple[str, ...] = ()
    marks: Mapping[str, Mapping[str, Any]] = {}
    scale: tuple[ScalarMappable, str] | None = None


def caption_tile(axes: Axes, text: str, is_correct: bool = False) -> None:
    """Write a line of text below a tile, in bold green with a tick if `is_correct`."""
    colour, weight = (_CORRECT_COLOUR, "bold") if is_correct else (GREY, "normal")
    axes.set_xlabel(f"{'✓ ' if is_correct else ''}{text}", fontsize=9, color=colour, fontweight=weight)


def opposite_direction(record: Record) -> Float[np.ndarray, "3"]:
    """Return the direction (any length) of an eye above the object, on the side that the first view hides."""
    run = next(iter(record["methods"].values()))
    position = np.asarray(run["views"][0]["position"])
    direction = -position[[0, 2]]
    length = np.linalg.norm(direction)
    direction = direction / length if length > 1e-3 else np.array([0.6, 0.8])
    return np.array([direction[0], 0.55, direction[1]])


def render_mesh(
    mesh: TriangleMesh,
    eye: Float[np.ndarray, "3"],
    size: int,
    value: Callable[[np.ndarray], Float[np.ndarray, " n"]] | None = None,
) -> Still:
    """Render a mesh, seen from the direction `eye`, in an image of `size` x `size` pixels.

    - `value`: function from points to values. The values, at least 1e-6, colour the surface on the scale `ERRORS`. By
      default the surface has one colour.
    """
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _MAX_EDGE, max_iter=12)
    fine = trimesh.Trimesh(vertices, faces)
    values = np.ones(len(fine.vertices)) if value is None else np.maximum(value(fine.vertices), 1e-6)
    surface = MeanSurface(np.asarray(fine.vertices), np.asarray(fine.faces), np.asarray(fine.vertex_normals), values)
    return Still(eye, surface, size, _IMAGE_RADIUS, None if value is None else ERRORS)


def draw_on(
    axes: Axes, rendering: Still, points: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n channels"]
) -> None:
    """Draw a rendered image, and on it the points (scene coordinates) that its surface does not hide."""
    axes.imshow(rendering.image, interpolation="antialiased", zorder=1)
    pixels, in_front = rendering.project(points)
    depth = (points - np.asarray(rendering.pose.position)) @ np.asarray(rendering.pose.forward)
    order = np.argsort(-depth)
    order = order[in_front[order]]
    axes.scatter(pixels[order, 0], pixels[order, 1], s=2.5, c=colours[order], linewidths=0, zorder=2)
    object_pixels = np.argwhere(rendering.image[..., 3] > 0)
    middle = 0.5 * (object_pixels.min(axis=0) + object_pixels.max(axis=0))
    half = 0.55 * np.ptp(object_pixels, axis=0).max()
    axes.set(xlim=middle[1] + [-half, half], ylim=middle[0] + [half, -half])
