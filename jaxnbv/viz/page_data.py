"""What the page draws itself, as JSON: the map of each view and, once a reader turns it, the scene in space."""

import base64
import io
import math

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import Normalize
from PIL import Image

from jaxnbv.acquisition import Quantity
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.viz import sphere
from jaxnbv.viz.choice import Ascents, Choice, colour_range
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.figures import deviation_range
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.render import FRUSTUM_DEPTH, frustum
from jaxnbv.viz.style import (
    BEFORE,
    DEVIATION,
    GREY,
    INK,
    LINE,
    NEW,
    VALUE,
    VALUE_LINES,
    colour_scale,
    spaced_ticks,
)
from jaxnbv.viz.trajectory_figures import frusta_steps, small_frusta

# Of all views together, so that a long episode stays a small page.
_MAX_POINTS, _MAX_VERTICES = 9000, 48_000
_FEWEST_POINTS, _MOST_POINTS = 400, 1500
_FEWEST_VERTICES, _MOST_VERTICES = 1500, 6000
# Coordinates and deviations are written in so many steps of their ranges.
_STEPS, _GRADES = 1023, 63
_QUALITY = 82
# Between numbers under the bar, of its width on a phone.
_TICK_GAP = 0.14


def payload(data: ReportData) -> dict:
    """All but the scene in space."""
    return {
        "views": [
            {
                "told": view.told,
                "matrix": _matrix(data.frame, view.pose),
                "choice": None if view.choice is None else _choice(view.choice, data.quantity),
            }
            for view in data.views
        ],
        "deviation": {
            "range": np.log10(deviation_range(data)).tolist(),
            "colours": colour_scale(DEVIATION),
        },
        "value": {"colours": colour_scale(VALUE), "lines": colour_scale(VALUE_LINES)},
        "map": {
            "graticule": [line.round(3).tolist() for line in sphere.graticule()],
            "width": sphere.WIDTH,
            "height": sphere.HEIGHT,
        },
        "style": {"ink": INK, "grey": GREY, "line": LINE, "before": BEFORE, "new": NEW},
    }


def deviation_ticks(data: ReportData) -> list[tuple[float, str]]:
    """The numbers under the bar of deviations, and where they stand, in percent of its width."""
    low, high = deviation_range(data)
    ticks = spaced_ticks(low, high, _TICK_GAP)
    places = 100.0 * np.log(ticks / low) / np.log(high / low)
    return [(round(place, 2), f"{tick:g}") for place, tick in zip(places.tolist(), ticks.tolist(), strict=True)]


def space(data: ReportData, camera: Camera) -> dict:
    """The scene in space, for a reader who turns it."""
    count = len(data.views)
    points = min(max(_MAX_POINTS // count, _FEWEST_POINTS), _MOST_POINTS)
    vertices = min(max(_MAX_VERTICES // count, _FEWEST_VERTICES), _MOST_VERTICES)
    return {
        "eye": data.stage.eye.round(4).tolist(),
        "extent": data.stage.extent,
        "pull": data.stage.pull,
        "shrink": data.stage.depth / FRUSTUM_DEPTH,
        "views": [
            {
                "new": _thinned(view.new, points),
                "pull": data.stage.pull_of(view.pose),
                "frustum": frustum(view.pose, camera).round(4).tolist(),
                "surface": None if view.surface is None else _surface(view.surface, vertices),
                "guesses": None if view.guesses is None else _surface(view.guesses, _FEWEST_VERTICES),
                "ascents": None if view.spatial_ascents is None else _spatial(view.spatial_ascents, camera),
            }
            for view in data.views
        ],
    }


def _matrix(frame: Frame | None, pose: Pose) -> list[list[float]]:
    """Camera to the world of the object's file, or to the scene where there is none, by OpenCV's axes."""
    placed = pose if frame is None else frame.to_world(pose)
    return np.asarray(placed.to_matrix(), np.float64).round(6).tolist()


def picture_address(picture: UInt8[np.ndarray, "h w _"]) -> str:
    """An image as a data address; one of few pixels, each of which counts, without loss."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="WEBP", quality=_QUALITY, lossless=min(picture.shape[:2]) < 64)
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode()


def _thinned(points: Float[np.ndarray, "n 3"], limit: int) -> list[list[float]]:
    """At most `limit` rows, evenly taken, rounded to what a screen can show."""
    rows = np.linspace(0, len(points) - 1, min(limit, len(points))).astype(int)
    return np.round(points[rows].astype(np.float64), 3).tolist()


def clustered(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], limit: int
) -> tuple[Int[np.ndarray, " v"], Int[np.ndarray, "g 3"]]:
    """A coarser mesh of at most `limit` vertices: the cluster of each vertex, those within one cell of a lattice, and
    the faces between clusters (Rossignac and Borrel 1993)."""
    own = np.arange(len(vertices))
    cell = 0.01
    while own.max(initial=-1) + 1 > limit:
        steps = np.floor(vertices / cell).astype(np.int64)
        steps -= steps.min(axis=0)
        _, own = np.unique(np.ravel_multi_index(steps.T, steps.max(axis=0) + 1), return_inverse=True)
        cell *= 1.2
    joined = own[faces]
    a, b, c = joined.T
    return own, joined[(a != b) & (b != c) & (c != a)]


def _surface(surface: MeanSurface, limit: int) -> dict:
    """Columns of vertices and logarithms of deviations in whole steps, from the lowest; of each face its first corner
    less that of the face before, and its others less its first. Small numbers, which pack well."""
    own, faces = clustered(surface.vertices, surface.faces, limit)
    count = np.bincount(own)
    vertices = np.stack([np.bincount(own, column) / count for column in surface.vertices.T], axis=1)
    deviation = np.bincount(own, np.log10(surface.deviation)) / count
    # The least corner comes first, by which the faces are in order.
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    turned = turned[np.lexsort(turned.T[::-1])]
    first = turned[:, :1]
    low, step, columns = _in_steps(vertices, _STEPS)
    least, grade, grades = _in_steps(deviation, _GRADES)
    return {
        "low": low,
        "step": step,
        "vertices": columns.T.tolist(),
        "faces": np.concatenate([np.diff(first, axis=0, prepend=0), turned[:, 1:] - first], axis=1).ravel().tolist(),
        "least": least,
        "grade": grade,
        "deviation": grades.tolist(),
    }


def _in_steps(values: Float[np.ndarray, "*n"], steps: int) -> tuple[float, float, Int[np.ndarray, "*n"]]:
    """The least value, the size of a step, and how many steps each value is above the least."""
    low = float(values.min())
    step = max(float(values.max()) - low, 1e-12) / steps
    return low, step, np.round((values - low) / step).astype(int)


def _choice(choice: Choice, quantity: Quantity) -> dict:
    errors = None if choice.errors is None else [_number(float(f"{error:.4g}")) for error in choice.errors.tolist()]
    return {
        "places": sphere.mollweide(choice.directions).round(3).tolist(),
        "directions": choice.directions.round(2).tolist(),
        "values": [_number(value) for value in choice.values.tolist()],
        "errors": errors,
        "tied": [] if choice.tied is None or not choice.rings_tied else np.flatnonzero(choice.tied).tolist(),
        "chosen": sphere.mollweide(choice.chosen[None]).round(4)[0].tolist(),
        "value": choice.value,
        "error": None if choice.error is None else _number(choice.error),
        "range": choice.range,
        "image": _map_image(choice) if choice.makes_a_map(quantity) else None,
        "ascents": None if choice.ascents is None else _on_map(choice.ascents),
        "caption": _map_caption(choice),
    }


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


def _map_caption(choice: Choice) -> str:
    """What the marks on the map are that not every map has."""
    parts = []
    if choice.rings_tied:
        parts.append("Rings: level with the best, within two standard errors of the difference.")
    elif choice.num_tied:
        parts.append(f"The samples cannot tell the best from {choice.num_tied} of the others: no rings are drawn.")
    if choice.ascents is not None:
        parts.append("Lines: gradient ascents, from a ring where they start to a dot where they end.")
        if choice.ascents.is_spatial:
            parts.append(
                "They change position and rotation; drawn is the direction of the position, over a map of cameras that "
                "look at the centre from the sphere where the ascents start."
            )
    if not np.array_equal(choice.map.directions, choice.directions):
        parts.append(
            "The candidates are too few for a map, or off the sphere: it is drawn from "
            f"{len(choice.map.values)} more views, valued with the same posterior samples."
        )
    return " ".join(parts)


def _on_map(ascents: Ascents) -> dict:
    starts, ends = (sphere.mollweide(ascents.directions[:, step]).round(4).tolist() for step in (0, -1))
    return {
        "ways": [piece.round(3).tolist() for directions in ascents.directions for piece in sphere.path(directions)],
        "starts": starts,
        "ends": ends,
        "values": ascents.values[:, [0, -1]].tolist(),
    }


def _spatial(ascents: Ascents, camera: Camera) -> dict:
    return {
        "positions": np.asarray(ascents.poses.position, dtype=np.float64).round(3).tolist(),
        "values": ascents.values.tolist(),
        "range": colour_range(ascents.values),
        "steps": frusta_steps(ascents).tolist(),
        "frusta": [small_frusta(ascents, i, camera).round(3).tolist() for i in range(len(ascents.values))],
    }


def _map_image(choice: Choice) -> str:
    """The smooth map, coloured as the candidates are; clear outside the rim, where it is NaN."""
    values = sphere.smooth_map(choice.map.directions, choice.map.values)
    return picture_address(VALUE(Normalize(*choice.range)(values), bytes=True))
