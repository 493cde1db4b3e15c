"""Pictures of the surfaces that a step imagined, as the chosen camera would see them."""

import math
from typing import NamedTuple, TypeAlias

import equinox as eqx
import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray, UInt8
from scipy.spatial import cKDTree

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import View, view_keys
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.scanning import TriangleMesh, barrier_of, scan
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.viz.placed_shape import placed_parts
from jaxnbv.viz.sphere import unit
from jaxnbv.viz.style import BEFORE, NEW

# Vertices and faces.
Triangles: TypeAlias = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]

NUM_SHOWN = 4
_PIXELS = 96
# Colours of surface that an earlier view saw, and of other imagined surface. The second is light, so that shading shows
# the shape.
_SEEN_COLOUR, _UNSEEN_COLOUR = "#c3c9d2", "#5b8fc7"
# A point counts as seen before if its distance to the cloud is below this (scene units) or this many point spacings.
_MAX_DISTANCE, _MAX_SPACINGS = 0.05, 3.0


class ShadedImage(eqx.Module):
    """A picture of a surface: where rays hit it, brightness in [0, 1], and where an earlier view saw it."""

    mask: Bool[np.ndarray, "h w"]
    brightness: Float[np.ndarray, "h w"]
    is_seen: Bool[np.ndarray, "h w"]


class Imagined(eqx.Module):
    """Pictures of the surfaces that a step imagined, before its view was taken.

    - `samples`, `names`: pictures and names of some sampled surfaces or of the likeliest parts, from the chosen pose.
    - `kinds`: kinds of known shapes with their probabilities. Empty without known shapes.
    """

    samples: tuple[ShadedImage, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[tuple[str, float], ...] = eqx.field(static=True)


def render_imagined(episode: Episode, index: int, inputs: StepInputs) -> Imagined | None:
    """Return pictures of the surfaces imagined before view `index` (from 0).

    Return None if the planner did not choose this view, or if the search used neither samples nor parts.

    - `inputs`: inputs of the step that chose the view, with the samples.
    """
    planner, view = episode.planner, episode.views[index]
    parts = inputs.observations.hypotheses if planner.acquisition.needs_hypotheses else None
    if view.proposal is None or (inputs.surfaces is None and parts is None):
        return None
    camera, cloud = _fine_camera(planner.camera), inputs.observations.cloud.to_numpy()[0]
    barrier, samples = barrier_of(planner.obstacles, camera, view.pose), list[ShadedImage]()
    # Scan triangles. Scans of other surfaces must be compiled, which takes too long for a picture of this size.
    if isinstance(parts, PartHypotheses):
        likely = placed_parts(parts, NUM_SHOWN)
        names, kinds = [part.name for part in likely], parts.names()
        meshes: list[TriangleMesh | None] = [TriangleMesh(part.vertices, part.faces, Frame()) for part in likely]
    else:
        sample_key, *_ = view_keys(episode.key, index)
        shapes, triangles, kinds = sampled_surfaces(planner.sampler, inputs, sample_key)
        names = [shape or f"imagined {number}" for number, shape in enumerate(shapes, start=1)]
        meshes = [None if one is None else TriangleMesh(*one, Frame()) for one in triangles]
    for mesh in meshes:
        if mesh is None:
            empty = np.zeros((camera.height, camera.width))
            samples.append(ShadedImage(empty > 0, empty, empty > 0))
            continue
        samples.append(shaded_image(scan(mesh, camera, view.pose, barrier), camera, view.pose, cloud))
    return Imagined(tuple(samples), tuple(names), tuple(kinds.items()))


def sampled_surfaces(
    sampler: SurfaceSampler, inputs: StepInputs, key: PRNGKeyArray
) -> tuple[list[str], list[Triangles | None], dict[str, float]]:
    """Return names and triangles of at most four samples, and the probabilities of kinds of known shapes.

    - `inputs`: inputs of a step, with a posterior, and with samples drawn with `key`.
    """
    assert inputs.surfaces is not None
    assert inputs.posterior is not None
    # Marching cubes needs a writable array.
    meshes = [level_triangles(values, sampler.grid) for values in np.array(inputs.surfaces.values[:NUM_SHOWN])]
    names = inputs.posterior.names_of_samples(key, sampler.num_samples)[: len(meshes)]
    return names, [None if mesh is None else mesh[:2] for mesh in meshes], inputs.posterior.kinds()


def view_image(view: View, cloud: Float[np.ndarray, "n 3"]) -> ShadedImage | None:
    """Return the picture of a view's scan; None if the scan is not an image. `cloud`: points seen before."""
    is_image = view.scan.capacity == view.camera.num_rays
    return shaded_image(view.scan, view.camera, view.pose, cloud) if is_image else None


def shaded_image(view_scan: PointCloud, camera: Camera, pose: Pose, cloud: Float[np.ndarray, "n 3"]) -> ShadedImage:
    """Return the picture of a scan that has one row per pixel. `cloud`: points seen before."""
    points, normals = (np.asarray(rows, np.float64) for rows in (view_scan.points, view_scan.normals))
    mask = np.asarray(view_scan.mask)
    brightness = np.clip(0.35 + 0.65 * normals @ lamp(pose), 0.0, 1.0)
    tree = cKDTree(cloud)
    spacing = np.median(tree.query(cloud, k=2)[0][:, 1]) if len(cloud) > 1 else 0.0
    is_seen = mask & (tree.query(points)[0] < max(_MAX_DISTANCE, _MAX_SPACINGS * spacing))
    shape = camera.height, camera.width
    return ShadedImage(mask.reshape(shape), brightness.reshape(shape), is_seen.reshape(shape))


def lamp(pose: Pose) -> Float[np.ndarray, "3"]:
    """Return the unit vector toward the lamp of a picture from this pose. The lamp is beside the camera."""
    right, down, forward = np.asarray(pose.rotation, np.float64).T
    return unit(-forward - 0.5 * right - 0.7 * down)


def _fine_camera(camera: Camera) -> Camera:
    factor = math.ceil(_PIXELS / max(camera.height, camera.width))
    return camera if factor == 1 else camera.resized(factor * camera.height, factor * camera.width)


def colour_image(image: ShadedImage, new_colour: str = BEFORE, is_plain: bool = False) -> UInt8[np.ndarray, "h w 3"]:
    """Colour a picture: grey where an earlier view saw the surface, or if `is_plain`; else `new_colour`."""
    tints = np.array([mpl.colors.to_rgb(colour) for colour in (new_colour, _SEEN_COLOUR)])
    colours = tints[(image.is_seen | is_plain).astype(int)] * (0.25 + 0.75 * image.brightness[..., None])
    return np.round(255.0 * np.where(image.mask[..., None], colours, 1.0)).astype(np.uint8)


class Tile(NamedTuple):
    """A small picture and its caption."""

    name: str
    picture: UInt8[np.ndarray, "h w 3"]


def image_tiles(imagined: Imagined, view_image: ShadedImage | None) -> list[Tile]:
    """Return coloured pictures of the imagined surfaces, and of what the view then saw."""
    pairs = zip(imagined.names, imagined.samples, strict=True)
    tiles = [Tile(name, colour_image(sample, _UNSEEN_COLOUR)) for name, sample in pairs]
    return tiles if view_image is None else [*tiles, Tile("then seen", colour_image(view_image, NEW))]
