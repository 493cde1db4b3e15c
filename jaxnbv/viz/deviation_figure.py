"""Draws a CAD model from two sides, coloured by a scan's deviation, with the worst places numbered."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.scanning.mesh import TriangleMesh
from jaxnbv.scanning.triangle_rays import first_faces
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.imagined import lamp
from jaxnbv.viz.render import Still, crop
from jaxnbv.viz.sphere import unit
from jaxnbv.viz.style import INK

# Blue where material is missing, red where there is too much; grey where nothing was scanned.
_COLOURS, _BLANK = mpl.colormaps["RdBu_r"], "#76808f"
# Pixels along each side of a picture. Width and height of the figure in inches.
_SIZE, _WIDTH, _HEIGHT = 640, 7.2, 3.7
# Number of viewing directions to choose from, and largest height |y| of these unit vectors. Number of points on the CAD
# whose visibility decides, and distance from the surface at which their rays to the viewer start.
_NUM_EYES, _MAX_HEIGHT, _NUM_SAMPLES, _CLEARANCE = 120, 0.7, 400, 0.02
# Weight of a numbered place's visibility, where a fully scanned surface has weight 1 in total. Weight of a point that
# was not scanned, relative to a scanned point.
_PLACE_WEIGHT, _UNSCANNED_WEIGHT = 1.0, 1.0 / 3.0

# Function that returns the deviations at places on the CAD, given the places and their normals. NaN if not scanned.
Values = Callable[[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]], Float[np.ndarray, " m"]]


class Mark(NamedTuple):
    """A numbered place: the point of the CAD, its outward normal, and the deviation there."""

    position: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    deviation: float


def deviation_figure(
    cad: TriangleMesh, values_at: Values, marks: Sequence[Mark], limit: float, unit_name: str, caption: str, up: str
) -> Figure:
    """Draw the CAD from two sides, coloured by deviation, with numbered places. Size: 7.2 by 3.7 inches.

    - `values_at`: see `Values`. `marks`: places to number, at least one, in the coordinates of `cad`.
    - `limit`: the colour scale goes from -`limit` to `limit`. `up`: upward axis of `cad`, see `Frame`.
    """
    scene = TriangleMesh.from_arrays(cad.vertices, cad.faces, up)
    positions = np.asarray(scene.frame.to_scene(np.stack([mark.position for mark in marks])))
    normals = np.stack([mark.normal for mark in marks]) @ scene.frame.rotation.T
    colours = ScalarMappable(Normalize(-limit, limit), _COLOURS)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, _HEIGHT))
        for side, eye in enumerate(_two_eyes(scene, values_at, positions, normals)):
            axes = figure.add_axes((0.01 + 0.43 * side, 0.16, 0.42, 0.82))
            still = _render(scene, eye, values_at, colours)
            axes.imshow(still.image, interpolation="bilinear", zorder=1)
            pixels = still.project(scene.vertices)[0]
            crop(axes, still, [pixels])
            _number(axes, still, positions, pixels.mean(axis=0))
        bar = figure.colorbar(colours, cax=figure.add_axes((0.89, 0.22, 0.016, 0.68)))
        bar.ax.ticklabel_format(scilimits=(-2, 4))
        bar.outline.set_visible(False)
        bar.set_label(f"deviation ({unit_name})")
        listing = "    ".join(f"{number}:  {mark.deviation:+.3g}" for number, mark in enumerate(marks, start=1))
        figure.text(0.03, 0.1, f"worst places    {listing}".replace("-", "−"), va="center")
        figure.text(0.03, 0.04, caption, va="center")
        figure.text(0.97, 0.04, "■ not scanned", color=_BLANK, ha="right", va="center")
    return figure


def _two_eyes(
    scene: TriangleMesh, values_at: Values, positions: Float[np.ndarray, "k 3"], outward: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "2 3"]:
    """Return unit vectors toward two viewers who together see most of the scan and of the numbered places.

    - `positions`, `outward`: numbered places and the outward normals there, in scene coordinates.
    """
    mesh = scene.to_trimesh()
    samples, rows = trimesh.sample.sample_surface(mesh, _NUM_SAMPLES, seed=0)
    normals = mesh.face_normals[rows]
    is_scanned = np.isfinite(values_at(*_to_world(scene, samples, normals)))
    weight = np.where(is_scanned, 1.0, _UNSCANNED_WEIGHT) / _NUM_SAMPLES
    samples, normals = np.concatenate([samples, positions]), np.concatenate([normals, outward])
    weight = np.concatenate([weight, np.full(len(positions), _PLACE_WEIGHT)])
    eyes = np.asarray(fibonacci_sphere(_NUM_EYES), np.float64)
    eyes = eyes[np.abs(eyes[:, 1]) < _MAX_HEIGHT]
    rays = np.repeat(eyes[None], len(samples), axis=0)
    origins = samples[:, None] + _CLEARANCE * (rays + normals[:, None])
    hits, _ = first_faces(scene.vertices, scene.faces)(origins.reshape(-1, 3), rays.reshape(-1, 3))
    # Oblique surface counts less.
    visible = np.clip(normals @ eyes.T, 0.0, 1.0) * (hits < 0).reshape(len(samples), -1)
    first = int(np.argmax(weight @ visible))
    gain = np.maximum(visible - visible[:, [first]], 0.0)
    return eyes[[first, int(np.argmax(weight @ gain))]]


def _to_world(
    scene: TriangleMesh, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    return np.asarray(scene.frame.to_world(points)), normals @ scene.frame.rotation


def _render(scene: TriangleMesh, eye: Float[np.ndarray, "3"], values_at: Values, colours: ScalarMappable) -> Still:
    still = Still(eye, None, _SIZE, scene.bounding_radius)
    directions = np.asarray(still.fine_camera.pixel_directions()) @ np.asarray(still.pose.rotation).T
    origin = np.asarray(still.pose.position, np.float64)
    hits = scene.trace(np.broadcast_to(origin, directions.shape), unit(directions))
    mask = np.asarray(hits.mask)
    points, normals = (np.asarray(rows, np.float64)[mask] for rows in (hits.points, hits.normals))
    values = values_at(*_to_world(scene, points, normals))
    blank = np.array(mpl.colors.to_rgba(_BLANK))
    tints = np.where(np.isnan(values)[:, None], blank, colours.to_rgba(np.nan_to_num(values)))
    tints[:, :3] *= (0.8 + 0.2 * np.clip(normals @ lamp(still.pose), 0.0, 1.0))[:, None]
    still.show(mask, tints, (points - origin) @ np.asarray(still.pose.forward, np.float64))
    return still


def _number(axes: Any, still: Still, positions: Float[np.ndarray, "k 3"], center: Float[np.ndarray, "2"]) -> None:
    """Write the number of each visible place (scene coordinates) beside it, away from the pixel `center`."""
    pixels, in_front = still.project(positions)
    for number, (pixel, is_visible) in enumerate(zip(pixels, in_front, strict=True), start=1):
        if not is_visible:
            continue
        direction = (pixel - center) / max(float(np.linalg.norm(pixel - center)), 1.0)
        style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8, "fontweight": "bold", "zorder": 5}
        axes.annotate(
            str(number),
            pixel,
            (16 * direction[0], -16 * direction[1]),
            textcoords="offset points",
            bbox={"boxstyle": "circle,pad=0.25", "fc": "white", "ec": INK, "lw": 0.8},
            arrowprops={"arrowstyle": "-", "color": INK, "lw": 0.8, "shrinkA": 0, "shrinkB": 0},
            **style,
        )
