"""The trajectories of a gradient search: lines on the map of the sphere, frusta in space."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from jaxnbv.geometry.camera import Camera
from jaxnbv.viz import sphere
from jaxnbv.viz.answers import label_of
from jaxnbv.viz.choice import Ascents, colour_range
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.layout import fitted, flow
from jaxnbv.viz.render import Still, draw_cameras, draw_points, draw_segments, frame, frustum
from jaxnbv.viz.style import BEFORE, INK, VALUE_LINES

_FRUSTA = 4
_DEPTH = 0.16


def draw_ascents(axes: Axes, ascents: Ascents, weight: float = 1.0) -> None:
    """Draw trajectories on the map of the sphere, each from a ring to a dot."""
    rim: dict[str, Any] = {"color": "white", "lw": 2.2 * weight, "solid_capstyle": "round", "zorder": 6}
    for directions in ascents.directions:
        for piece in sphere.path(directions):
            axes.plot(*piece.T, **rim)
            axes.plot(*piece.T, color=INK, lw=1.1 * weight, solid_capstyle="round", zorder=7)
    mark: dict[str, Any] = {"ls": "none", "marker": "o"}
    starts, ends = (sphere.mollweide(ascents.directions[:, step]) for step in (0, -1))
    axes.plot(*starts.T, ms=4.6 * weight, mew=1.0 * weight, mfc="white", mec=INK, zorder=8, **mark)
    axes.plot(*ends.T, ms=3.4 * weight, mew=0.5 * weight, mfc=INK, mec="white", zorder=9, **mark)


def frusta_steps(ascents: Ascents) -> Int[np.ndarray, " f"]:
    """The steps at which a trajectory's cameras are drawn: the first, the last and some between."""
    steps = ascents.values.shape[1]
    return np.unique(np.linspace(0, steps - 1, _FRUSTA).round().astype(int))


def small_frusta(ascents: Ascents, start: int, camera: Camera) -> Float[np.ndarray, "f lines 2 3"]:
    """Edges of the cameras at `frusta_steps` along one trajectory."""
    return np.stack([frustum(ascents.poses[start, step], camera, _DEPTH) for step in frusta_steps(ascents)])


def trajectory_figure(data: ReportData, index: int, camera: Camera) -> Figure:
    """The ascents that led to view `index` (from 0), in space: what was known, cameras so far and the one chosen."""
    view, known = data.views[index], data.views[index - 1]
    ascents = view.spatial_ascents
    assert ascents is not None
    figure = Figure(figsize=(4.3, 4.9))
    axes = figure.add_axes((0.0, 0.13, 1.0, 0.79))
    positions = np.asarray(ascents.poses.position, dtype=np.float64)
    poses = [other.pose for other in data.views[: index + 1]]
    extent = max(1.8, *(other.extent for other in data.views[: index + 1]))
    still = Still(data.stage.eye, known.surface, 900, extent)
    still.paint(None)
    axes.imshow(still.image, interpolation="bilinear", zorder=1)
    shown = [draw_points(axes, still, view.before, BEFORE, 0.7)]
    if known.surface is not None:
        shown.append(still.project(known.surface.vertices)[0])
    colours = ScalarMappable(Normalize(*colour_range(ascents.values)), VALUE_LINES)
    for start, values in enumerate(ascents.values):
        ways = np.stack([positions[start, :-1], positions[start, 1:]], axis=1)
        shown.append(draw_segments(axes, still, ways, colours.to_rgba(values[1:]), 1.6))
        frusta = small_frusta(ascents, start, camera)
        steps = frusta_steps(ascents)
        for edges, value, width in zip(frusta, values[steps], np.linspace(0.5, 1.3, len(steps)), strict=True):
            rows = np.tile(colours.to_rgba(value), (len(edges), 1))
            shown.append(draw_segments(axes, still, edges, rows, float(width)))
    shown += draw_cameras(axes, still, poses, camera, 1.0, beyond=view.extent)
    frame(axes, still, shown)
    for label in axes.texts:
        label.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
    figure.text(0.03, 0.95, f"Gradient ascents to view {view.number}", fontsize=10, fontweight="bold")
    marks = [("● points before", BEFORE), ("cameras of ascents: thin at the start, thick at the end", INK)]
    flow(figure, marks, 0.03, 0.918, 0.94, 0.035, 8.0)
    bar = figure.colorbar(colours, cax=figure.add_axes((0.14, 0.1, 0.72, 0.02)), orientation="horizontal")
    bar.outline.set_visible(False)
    fitted(figure, 0.5, 0.02, f"{label_of(data.quantity)} along the ascents", 0.94, 9.0, ha="center", va="center")
    return figure
