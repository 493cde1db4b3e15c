"""3-D figures of the scene for the report, made with plotly. A reader can turn them."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float, Int

from jaxnbv.viz.data import ReportData
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.placed_shape import PlacedShape
from jaxnbv.viz.scene import Cameras, Points, frustum, scene_items
from jaxnbv.viz.style import DEVIATION, DISPUTED, IMAGINED, INK, OPEN, PART, colour_scale

# For a small page: largest numbers of points and of vertices in all views together. Least number of vertices in a view.
_MAX_POINTS, _MAX_VERTICES, _MIN_VERTICES = 18_000, 24_000, 1500
# Coordinates are rounded to multiples of this, in scene units. Multiples of a power of two compress well.
_ROUNDING = 1 / 256
_GLASS = {"color": DISPUTED, "opacity": 0.25}
_LIGHT = {"ambient": 0.72, "diffuse": 0.45, "specular": 0.04, "roughness": 0.9}


def figures_in_space(data: ReportData) -> list[go.Figure]:
    """Return one plotly figure per view. Items that a reader hides stay hidden in the next figure."""
    viewpoint, count, figures = data.viewpoint, max(len(data.views), 6), []
    points, vertices = _MAX_POINTS // count, max(_MAX_VERTICES // count, _MIN_VERTICES)
    grades = np.log10(data.deviations)
    for index, view in enumerate(data.views):
        poses = [viewpoint.drawn_pose(other.pose) for other in data.views[: index + 1]]
        traces = [] if view.surface is None else [_mesh(view.surface, vertices, grades)]
        if isinstance(view.surface, PlacedShape) and (disputed_space := view.surface.disputed_space) is not None:
            traces.append(_triangles(disputed_space, vertices // 2, _legend_entry("other shapes") | _GLASS))
        for item in scene_items(view.before, view.new, poses, data.episode.sensor, viewpoint.depth):
            traces += _points(item, points) if isinstance(item, Points) else _cameras(item)
        figures.append(go.Figure(traces, _layout(viewpoint.eye, viewpoint.extent)))
    return figures


def _layout(eye: Float[np.ndarray, "3"], extent: float) -> dict[str, Any]:
    axis = {"range": [-extent, extent], "visible": False}
    x, y, z = (1.15 * eye).tolist()
    view = {"eye": {"x": z, "y": x, "z": y}, "projection": {"type": "perspective"}}
    scene = {f"{name}axis": axis for name in "xyz"}
    return {
        "scene": {**scene, "camera": view, "aspectmode": "cube", "dragmode": "turntable", "uirevision": "kept"},
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "itemsizing": "constant"},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "font": {"color": INK},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "uirevision": "kept",
        "template": "none",
    }


def _plotly_points(places: Float[np.ndarray, "n 3"]) -> dict[str, Any]:
    """Return coordinates keyed by plotly's axes. Plotly's vertical axis z is our y."""
    x, y, z = (_ROUNDING * np.round(np.asarray(places, np.float64).T / _ROUNDING)).astype(np.float32)
    return {"x": z, "y": x, "z": y}


def _legend_entry(name: str) -> dict[str, Any]:
    return {"name": name, "legendgroup": name, "hoverinfo": "skip", "showlegend": True}


def _points(item: Points, limit: int) -> list[dict[str, Any]]:
    rows = np.linspace(0, len(item.places) - 1, min(limit, len(item.places))).astype(int)
    marker = {"color": item.colour, "size": 1.0 + item.weight}
    places = _plotly_points(item.places[rows])
    return [{"type": "scatter3d", "mode": "markers", "marker": marker, **places, **_legend_entry(item.name)}]


def _cameras(item: Cameras) -> list[dict[str, Any]]:
    if not item.poses:
        return []
    edges = np.concatenate([frustum(pose, item.camera, item.depth) for pose in item.poses])
    gapped = np.pad(edges, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 3)
    line = {"color": item.colour, "width": 3.0 * item.weight}
    numbers = {
        **_plotly_points(1.09 * np.stack([np.asarray(pose.position, np.float64) for pose in item.poses])),
        "text": [f"<b>{item.first + i}</b>" for i in range(len(item.poses))],
        "textfont": {"color": item.colour, "size": 14},
    }
    lines = {"type": "scatter3d", "mode": "lines", "line": line, **_plotly_points(gapped), **_legend_entry(item.name)}
    return [lines, {"type": "scatter3d", "mode": "text", **numbers, **_legend_entry(item.name), "showlegend": False}]


def _mesh(surface: MeanSurface, limit: int, grades: Float[np.ndarray, "2"]) -> dict[str, Any]:
    """Return a plotly trace of a surface, see `_triangles`, in the colours of `Still`.

    - `grades`: decimal logarithms of the deviations at the ends of the colours.
    """
    if isinstance(surface, PlacedShape):
        # Disputed, imagined and scanned surface.
        scale = [[0.0, OPEN], [0.5, IMAGINED], [1.0, PART]]
        grade = np.maximum(surface.measured, 0.5 * surface.agreed)
        style = _legend_entry("likeliest shape") | {"cmin": 0.0, "cmax": 1.0, "colorscale": scale}
    else:
        grade = np.log10(surface.deviation)
        style = _legend_entry("surface of the mean")
        style |= {"cmin": grades[0], "cmax": grades[1], "colorscale": colour_scale(DEVIATION)}
    return _triangles(surface, limit, style | {"showscale": False}, grade)


def _triangles(
    surface: MeanSurface, limit: int, style: dict[str, Any], grade: Float[np.ndarray, " v"] | None = None
) -> dict[str, Any]:
    """Return a plotly trace of a surface, coarsened to at most `limit` vertices and coloured by `grade`."""
    new_index, faces = clustered(surface.vertices, surface.faces, limit)
    count = np.bincount(new_index)
    vertices = np.stack([np.bincount(new_index, column) / count for column in surface.vertices.T], axis=1)
    if grade is not None:
        style = style | {"intensity": np.round(np.bincount(new_index, grade) / count, 2).astype(np.float32)}
    return {
        "type": "mesh3d",
        **style,
        **_plotly_points(vertices),
        **dict(zip("ijk", faces.T.astype(np.uint16), strict=True)),
        "lighting": _LIGHT,
        "lightposition": {"x": 4000, "y": 3000, "z": 8000},
    }


def clustered(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], limit: int
) -> tuple[Int[np.ndarray, " v"], Int[np.ndarray, "g 3"]]:
    """Merge vertices in the same cell of a lattice, so that at most `limit` remain.

    Return the new index of each vertex, and the faces. The method is that of Rossignac and Borrel (1993).
    """
    new_index = np.arange(len(vertices))
    cell = 0.01
    while new_index.max(initial=-1) + 1 > limit:
        steps = np.floor(vertices / cell).astype(np.int64)
        steps -= steps.min(axis=0)
        _, new_index = np.unique(np.ravel_multi_index(steps.T, steps.max(axis=0) + 1), return_inverse=True)
        cell *= 1.2
    new_faces = new_index[faces]
    a, b, c = new_faces.T
    return new_index, np.unique(new_faces[(a != b) & (b != c) & (c != a)], axis=0)
