"""Still pictures of the scene after a view: a ray-traced surface with points and cameras."""

import math
from collections.abc import Iterable
from typing import Any

import matplotlib as mpl
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from scipy.ndimage import uniform_filter

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.scanning.triangle_rays import first_faces
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.imagined import colour_image, lamp
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.placed_shape import PlacedShape
from jaxnbv.viz.scene import Cameras, Points, frustum, scene_items
from jaxnbv.viz.sphere import unit
from jaxnbv.viz.style import DEVIATION, DISPUTED, LINE, NEW, draw_border, shape_colours

_DISTANCE = 11.0
_DEPTH_TOLERANCE = 0.04  # Noise, or an error of the mean, must not hide a point behind the surface that it lies on.
_HIDDEN_OPACITY = 0.18
# Hollows: width of the filter for the mean depth (fraction of the picture), largest darkening, and depth that gets it.
_OCCLUSION_WIDTH, _MAX_DARKENING, _FULL_DEPTH = 0.05, 0.4, 0.25
_INSET_SIZE = 0.24
# Opacity of the space that other hypotheses fill.
_DISPUTED_OPACITY = 0.3
_STILL_SIZE, _TRUTH_SIZE = 640, 280
# Longest edge of the triangles of a true surface, in scene units.
_MAX_EDGE = 0.05


def eye_beside(pose: Pose) -> Float[np.ndarray, "3"]:
    """Return a direction 40 degrees beside a camera, from which its scan and the camera are visible."""
    outward = unit(np.asarray(pose.position, dtype=np.float64))
    across = np.cross([0.0, 1.0, 0.0], outward)
    across = unit(across) if np.linalg.norm(across) >= 1e-3 else np.array([1.0, 0.0, 0.0])
    return math.cos(math.radians(40)) * outward + math.sin(math.radians(40)) * across


class Still:
    """A perspective picture of a surface, transparent where there is no surface.

    The light comes from beside the viewer, and hollows are darker. On a known shape, colours show which places are
    measured, which are imagined, and which differ in other hypotheses. Other surfaces are coloured by their standard
    deviation.

    - `eye`: direction from the origin to the viewer.
    - `size`: pixels along each side.
    - `extent`: radius of the content, in scene units.
    - `deviation`: range of standard deviations for the colours; None for one plain colour.
    """

    def __init__(
        self,
        eye: Float[np.ndarray, "3"],
        surface: MeanSurface | None,
        size: int,
        extent: float,
        deviation: LogNorm | None = None,
    ):
        self.size = size
        self.camera = Camera(2.0 * math.atan(1.08 * extent / _DISTANCE), size, size)
        self.pose = look_at(_DISTANCE * eye / np.linalg.norm(eye))
        self.image, self.depth = np.zeros((size, size, 4)), np.full((size, size), np.inf)
        if surface is not None:
            hits = self._trace(surface, deviation)
            if isinstance(surface, PlacedShape) and surface.disputed_space is not None:
                hits = self._blend_disputed(surface.disputed_space, *hits)
            self.show(*hits)

    def _trace(
        self, surface: MeanSurface, deviation: LogNorm | None
    ) -> tuple[Bool[np.ndarray, " rays"], Float[np.ndarray, "hits 4"], Float[np.ndarray, " hits"]]:
        """Return which rays of `fine_camera` hit the surface, and the colour and depth of each hit."""
        # Do not use the camera's compiled rays: for millions of pixels, XLA takes seconds for the constants.
        directions = unit(np.asarray(self.fine_camera.pixel_directions()) @ np.asarray(self.pose.rotation).T)
        origin, vertices = np.asarray(self.pose.position, np.float64), surface.vertices.astype(np.float64)
        trace = first_faces(vertices, surface.faces.astype(np.int64))
        rows, distances = trace(np.broadcast_to(origin, directions.shape), directions)
        mask = rows >= 0
        points = origin + distances[mask, None] * directions[mask]
        corners = surface.faces[rows[mask]]
        weight = _barycentric(points, vertices[corners])
        normals = unit(np.sum(weight[..., None] * surface.normals[corners], axis=1))
        brightness = 0.72 + 0.34 * np.clip(normals @ lamp(self.pose), -0.4, 1.0)
        colours = np.tile(mpl.colors.to_rgba(LINE), (len(points), 1))
        if isinstance(surface, PlacedShape):
            mixed = (np.sum(weight * values[corners], axis=1) for values in (surface.measured, surface.agreed))
            colours[:, :3] = shape_colours(*mixed)
        elif deviation is not None:
            colours = DEVIATION(deviation(np.exp(np.sum(weight * np.log(surface.deviation)[corners], axis=1))))
        depth = (points - np.asarray(self.pose.position)) @ np.asarray(self.pose.forward)
        shaded = brightness * (1.0 - _occlusion(mask.reshape(2 * self.size, -1), depth))
        colours[:, :3] = np.clip(colours[:, :3] * shaded[:, None], 0.0, 1.0)
        return mask, colours, depth

    def _blend_disputed(
        self,
        disputed_space: MeanSurface,
        mask: Bool[np.ndarray, " rays"],
        colours: Float[np.ndarray, "hits 4"],
        depth: Float[np.ndarray, " hits"],
    ) -> tuple[Bool[np.ndarray, " rays"], Float[np.ndarray, "all 4"], Float[np.ndarray, " all"]]:
        """Blend the disputed space, translucent, into the results of `_trace`. It hides no points.

        - `mask`, `colours`, `depth`: results of `_trace` for the opaque surface.
        """
        is_disputed, over, disputed_depth = self._trace(disputed_space, None)
        under, front = np.zeros((len(mask), 4)), np.zeros((len(mask), 4))
        deep, near = np.full(len(mask), np.inf), np.full(len(mask), np.inf)
        under[mask], deep[mask], near[is_disputed] = colours, depth, disputed_depth
        # Shade the disputed space: `over` is its brightness in the colour of a lit face.
        disputed, lit = (np.array(mpl.colors.to_rgb(colour)) for colour in (DISPUTED, LINE))
        front[is_disputed, :3] = disputed * (over[:, :3] / lit)
        front[is_disputed, 3] = _DISPUTED_OPACITY
        front[near > deep] = 0.0
        alpha = front[:, 3:] + under[:, 3:] * (1.0 - front[:, 3:])
        mixed = front[:, :3] * front[:, 3:] + under[:, :3] * under[:, 3:] * (1.0 - front[:, 3:])
        both = mask | (front[:, 3] > 0)
        result = np.concatenate([np.clip(mixed / np.maximum(alpha, 1e-9), 0.0, 1.0), alpha], axis=1)
        return both, result[both], deep[both]

    @property
    def fine_camera(self) -> Camera:
        """The picture's camera with four rays per pixel."""
        return Camera(self.camera.fov, 2 * self.size, 2 * self.size)

    def show(
        self, mask: Bool[np.ndarray, " rays"], colours: Float[np.ndarray, "hits 4"], depth: Float[np.ndarray, " hits"]
    ) -> None:
        """Make the picture from results of `_trace`."""
        image = np.zeros((len(mask), 4))
        image[mask] = colours
        image[:, :3] *= image[:, 3:]
        image = image.reshape(self.size, 2, self.size, 2, 4).mean(axis=(1, 3))
        image[..., :3] /= np.maximum(image[..., 3:], 1e-9)
        self.image = np.clip(image, 0.0, 1.0)
        deep = np.full(len(mask), np.inf)
        deep[mask] = depth
        self.depth = deep.reshape(self.size, 2, self.size, 2).min(axis=(1, 3))

    def project(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Project points (scene coordinates) to pixels. Also return whether each is in front of the surface."""
        local = (points - np.asarray(self.pose.position)) @ np.asarray(self.pose.rotation)
        pixels = self.camera.to_pixels(local[:, :2] / local[:, 2:])
        column, row = np.clip(pixels.astype(int), 0, self.size - 1).T
        return pixels - 0.5, local[:, 2] < self.depth[row, column] + _DEPTH_TOLERANCE


def _barycentric(points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    a, b, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb, pa, pb = (np.einsum("nd,nd->n", *pair) for pair in ((a, a), (a, b), (b, b), (p, a), (p, b)))
    area = np.maximum(aa * bb - ab**2, 1e-30)
    second, third = (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area
    weights = np.clip(np.stack([1.0 - second - third, second, third], axis=1), 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)


def _occlusion(mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, " hits"]) -> Float[np.ndarray, " hits"]:
    """Return the fraction by which to darken hits in hollows (Luft, Colditz and Deussen 2006)."""
    width, depths = round(_OCCLUSION_WIDTH * len(mask)), np.zeros(mask.shape)
    depths[mask] = depth
    # Two filters in a row, so that a pixel's weight falls off with distance.
    images = depths, mask.astype(float)
    sums, fractions = (uniform_filter(uniform_filter(image, width), width)[mask] for image in images)
    mean = sums / np.maximum(fractions, 1e-9)
    return _MAX_DARKENING * np.clip((depth - mean) / _FULL_DEPTH, 0.0, 1.0)


def draw_truth(axes: Axes, data: ReportData) -> bool:
    """Draw the true surface from the viewpoint of the other pictures. Return False if it is unknown."""
    mesh = data.true_surface
    if mesh is None:
        return False
    # Shading is interpolated between vertices, so they must be near each other.
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, _MAX_EDGE, max_iter=12)
    fine = trimesh.Trimesh(vertices, faces)
    surface = MeanSurface(fine.vertices, fine.faces, np.asarray(fine.vertex_normals), np.ones(len(fine.vertices)))
    still = Still(data.viewpoint.eye, surface, _TRUTH_SIZE, data.viewpoint.extent)
    axes.imshow(still.image, interpolation="bilinear")
    crop(axes, still, [still.project(np.asarray(fine.vertices))[0]])
    return True


def render_view(data: ReportData, index: int, size: int | None = None) -> Still:
    """Return a picture of the surface after view `index` (from 0). The default size is that for a report."""
    viewpoint, norm = data.viewpoint, LogNorm(*data.deviations)
    return Still(viewpoint.eye, data.views[index].surface, size or _STILL_SIZE, viewpoint.extent, norm)


def draw_scene(
    axes: Axes, data: ReportData, index: int, still: Still, weight: float = 1.0, inset: bool = True, aspect: float = 1.0
) -> None:
    """Draw surface, points and cameras after view `index` (from 0) into empty axes.

    If the surface is a known part, its name and probability are added.

    - `still`: see `render_view`.
    - `weight`: factor for the sizes of lines, dots and letters.
    - `inset`: whether to show the image of view `index` in the emptiest corner.
    - `aspect`: width divided by height.
    """
    view, viewpoint = data.views[index], data.viewpoint
    axes.imshow(still.image, interpolation="bilinear", zorder=1)
    poses = [viewpoint.drawn_pose(other.pose) for other in data.views[: index + 1]]
    items = scene_items(view.before, view.new, poses, data.episode.sensor, viewpoint.depth)
    if isinstance(view.surface, PlacedShape):
        # Scanned points must stand out on the imagined surface.
        items = tuple(item._replace(weight=2.0 * item.weight) if isinstance(item, Points) else item for item in items)
    draw_items(axes, still, items, weight)
    content = _content_pixels(data, still)
    crop(axes, still, content, aspect)
    if isinstance(view.surface, PlacedShape) and view.surface.is_part:
        style: dict[str, Any] = {"ha": "center", "va": "bottom", "fontsize": 10 * weight, "fontweight": "bold"}
        style["bbox"] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 2}
        axes.text(0.5, 0.01, view.surface.caption, transform=axes.transAxes, zorder=5, **style)
    if inset and view.image is not None:
        across, up = _free_corner(axes, content)
        wide, tall = _INSET_SIZE / aspect, _INSET_SIZE
        corner_axes = axes.inset_axes((across * (1 - wide), up * (1 - tall), wide, tall))
        corner_axes.imshow(colour_image(view.image, is_plain=True), interpolation="nearest")
        draw_border(corner_axes, NEW, 1.2 * weight)


def _free_corner(axes: Axes, content: list[Float[np.ndarray, "_ 2"]]) -> tuple[int, int]:
    """Return the corner with the fewest of these pixels: (0, 0) is bottom left, (1, 1) is top right."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    places = [(pixels - [left, bottom]) / [right - left, top - bottom] for pixels in content]

    def fraction_near(corner: tuple[int, int]) -> float:
        return sum(float(np.mean((np.abs(points - corner) < 1.25 * _INSET_SIZE).all(axis=1))) for points in places)

    return min(((0, 0), (0, 1), (1, 0), (1, 1)), key=fraction_near)


def _content_pixels(data: ReportData, still: Still) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the pixel coordinates of everything drawn in any view, so that all pictures share one crop."""
    surfaces = [view.surface.vertices for view in data.views if view.surface is not None]
    content = [still.project(rows)[0] for rows in (*surfaces, *(view.new for view in data.views)) if len(rows)]
    for view in data.views:
        pose = data.viewpoint.drawn_pose(view.pose)
        content.append(still.project(frustum(pose, data.episode.sensor, data.viewpoint.depth).reshape(-1, 3))[0])
        content.append(still.project(1.1 * np.asarray(pose.position, np.float64)[None])[0])
    return [np.clip(pixels, 0, still.size) for pixels in content]


def draw_items(
    axes: Axes, still: Still, items: Iterable[Points | Cameras], weight: float = 1.0
) -> list[Float[np.ndarray, "_ 2"]]:
    """Draw points that the surface does not hide, and numbered cameras. Return the pixels of all items."""
    content = []
    for item in items:
        if isinstance(item, Points):
            pixels, in_front = still.project(item.places)
            x, y = pixels[in_front].T
            axes.scatter(x, y, s=item.weight * weight, c=item.colour, linewidths=0, zorder=2)
            content.append(pixels)
            continue
        for number, pose in enumerate(item.poses, start=item.first):
            ends = frustum(pose, item.camera, item.depth)
            content.append(_draw_segments(axes, still, ends, item.colour, item.weight * weight))
            label_point = 1.09 * np.asarray(pose.position, np.float64)[None]
            (apex,), (apex_in_front,) = still.project(label_point)
            content.append(apex[None])
            style: dict[str, Any] = {"fontweight": "bold" if item.weight > 1.0 else "normal", "color": item.colour}
            style |= {"alpha": 1.0 if apex_in_front else 0.4, "fontsize": 9 * weight, "zorder": 4}
            axes.text(apex[0], apex[1], str(number), ha="center", va="center", **style)
    return content


def _draw_segments(
    axes: Axes, still: Still, ends: Float[np.ndarray, "n 2 3"], colour: str, width: float
) -> Float[np.ndarray, "m 2"]:
    """Draw segments (scene coordinates), faint where the surface hides them. Return pixels along the segments."""
    # Divide each segment into short ones, because the surface may hide a part of it.
    steps = np.linspace(0.0, 1.0, 25)[:, None, None]
    fine = ends[:, 0] + steps * (ends[:, 1] - ends[:, 0])
    pixels, in_front = still.project(fine.reshape(-1, 3))
    pixels, in_front = pixels.reshape(25, -1, 2), in_front.reshape(25, -1)
    segments = np.stack([pixels[:-1], pixels[1:]], axis=2).reshape(-1, 2, 2)
    is_visible = (in_front[:-1] & in_front[1:]).reshape(-1)
    colours = [mpl.colors.to_rgba(colour, alpha) for alpha in np.where(is_visible, 1.0, _HIDDEN_OPACITY)]
    axes.add_collection(LineCollection(list(segments), colors=colours, linewidths=width, capstyle="round", zorder=3))
    return pixels.reshape(-1, 2)


def crop(axes: Axes, still: Still, content: list[Float[np.ndarray, "_ 2"]], aspect: float = 1.0) -> None:
    """Crop the axes to the region of the pixels in `content`. The width is `aspect` times the height."""
    pixels = np.concatenate(content)
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    half = 0.53 * max((right - left) / aspect, bottom - top) + 0.03 * still.size
    x, y = 0.5 * (left + right), 0.5 * (top + bottom)
    axes.set(xlim=(x - aspect * half, x + aspect * half), ylim=(y + half, y - half), aspect="equal")
    axes.axis("off")
