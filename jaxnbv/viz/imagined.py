"""What a step imagined: sampled surfaces as the chosen camera would see them, and the depth that was expected there."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.colors import Normalize
from scipy.spatial import cKDTree

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Episode, View, view_keys
from jaxnbv.scanning import Evidence, GridSurface, TriangleMesh, mean_depth, scan
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.surfaces import KnownShapesPosterior, SurfacePosterior
from jaxnbv.viz.answers import number
from jaxnbv.viz.sphere import unit
from jaxnbv.viz.style import BEFORE, NEW

SHOWN = 4
_PIXELS = 96
# What had been seen before; and what was imagined elsewhere, lighter than the points, so that its shape shows.
_KNOWN, _UNSEEN = "#c3c9d2", "#5b8fc7"
# Nearer to the cloud than this, or than so many of its own spacings, a surface was seen before.
_SEEN, _SPACINGS = 0.05, 3.0


class Look(eqx.Module):
    """An image of a surface from a camera.

    - `mask`: which rays hit it; `depth`: along the camera's axis, in scene units, NaN where they do not.
    - `lit`: brightness by a lamp beside the camera, in [0, 1]; `known`: whether that place had been seen before.
    """

    mask: Bool[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]
    lit: Float[np.ndarray, "h w"]
    known: Bool[np.ndarray, "h w"]


class Imagined(eqx.Module):
    """What a step knew of its view before it was taken.

    - `samples`: some of its sampled surfaces, from the chosen pose.
    - `depth`: the mean over all samples that a ray hits, NaN where it misses most; in scene units.
    - `seen`: what was then seen from there, which may have other pixels; None where that is no image.
    - `names`: the known shape that each of `samples` is about; `kinds`: what it may be, and how likely that is. Both
      are empty where no shapes are known.
    """

    samples: tuple[Look, ...]
    depth: Float[np.ndarray, "h w"]
    seen: Look | None
    names: tuple[str, ...] = eqx.field(static=True, default=())
    kinds: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())


def imagined(
    episode: Episode,
    index: int,
    evidence: Evidence,
    posterior: SurfacePosterior,
    surfaces: GridSurface,
) -> Imagined | None:
    """What was imagined before view `index` (from 0) was taken; None for one that was not chosen.

    `evidence`: what was known before it; `posterior`: given that; `surfaces`: the step's samples.
    """
    planner, view = episode.planner, episode.views[index]
    if view.proposal is None:
        return None
    sample_key, *_ = view_keys(episode.key, index)
    camera, cloud = _finer(planner.camera), evidence.cloud.to_numpy()[0]
    scans = _scans(surfaces, camera, view.pose, planner.imagination)
    samples = tuple(
        look(jax.tree.map(lambda rows, at=sample: rows[at], scans), camera, view.pose, cloud)
        for sample in range(min(SHOWN, planner.imagination.num_samples))
    )
    expected = np.asarray(mean_depth(scans, view.pose), np.float64).reshape(camera.height, camera.width)
    names: tuple[str, ...] = ()
    kinds: tuple[tuple[str, float], ...] = ()
    if isinstance(posterior, KnownShapesPosterior):
        names = tuple(posterior.names_of_samples(sample_key, planner.imagination.num_samples)[: len(samples)])
        kinds = tuple(posterior.kinds().items())
    return Imagined(samples, expected, taken_look(view, cloud), names, kinds)


def _scans(surfaces: GridSurface, camera: Camera, pose: Pose, imagination: Imagination) -> PointCloud:
    """What the camera sees of each of s surfaces: clouds with a leading axis s.

    Of triangles: a picture is no reason to compile a scan of so many pixels.
    """
    barrier, found = imagination.barrier(camera, pose), []
    for values in np.array(surfaces.values):
        triangles = level_triangles(values, imagination.grid)
        if triangles is not None:
            found.append(scan(TriangleMesh(*triangles[:2], Frame()), camera, pose, barrier))
            continue
        misses = jnp.ones(camera.num_rays, bool)
        nowhere = jnp.zeros((*misses.shape, 3))
        found.append(PointCloud(nowhere, nowhere, ~misses, misses))
    return jax.tree.map(lambda *rows: np.stack(rows), *found)


def taken_look(view: View, cloud: Float[np.ndarray, "n 3"]) -> Look | None:
    """What a view saw; None where its scan is no image. `cloud`: what had been seen before it."""
    is_image = view.scan.capacity == view.camera.num_rays
    return look(view.scan, view.camera, view.pose, cloud) if is_image else None


def look(seen: PointCloud, camera: Camera, pose: Pose, cloud: Float[np.ndarray, "n 3"]) -> Look:
    """The image that a scan is, row by row; `cloud`: what had been seen before it."""
    points, normals = (np.asarray(rows, np.float64) for rows in (seen.points, seen.normals))
    mask = np.asarray(seen.mask)
    away = points - np.asarray(pose.position, np.float64)
    depth = np.where(mask, away @ np.asarray(pose.forward, np.float64), np.nan)
    lit = np.clip(0.35 + 0.65 * normals @ lamp(pose), 0.0, 1.0)
    tree = cKDTree(cloud)
    spacing = np.median(tree.query(cloud, k=2)[0][:, 1]) if len(cloud) > 1 else 0.0
    known = mask & (tree.query(points)[0] < max(_SEEN, _SPACINGS * spacing))
    shape = camera.height, camera.width
    return Look(mask.reshape(shape), depth.reshape(shape), lit.reshape(shape), known.reshape(shape))


def lamp(pose: Pose) -> Float[np.ndarray, "3"]:
    """The direction to a lamp beside a camera, a unit vector."""
    right, down, forward = np.asarray(pose.rotation, np.float64).T
    return unit(-forward - 0.5 * right - 0.7 * down)


def _finer(camera: Camera) -> Camera:
    """The camera with about as many pixels along its longer side as are shown."""
    factor = math.ceil(_PIXELS / max(camera.height, camera.width))
    return camera if factor == 1 else camera.resized(factor * camera.height, factor * camera.width)


def look_picture(look: Look, hidden: str = BEFORE, plain: bool = False) -> UInt8[np.ndarray, "h w 3"]:
    """A lit image of a look: grey where it had been seen before, in a colour of `hidden` elsewhere; white where a ray
    met nothing. `plain`: all in grey."""
    tints = np.array([mpl.colors.to_rgb(colour) for colour in (hidden, _KNOWN)])
    colours = tints[(look.known | plain).astype(int)] * (0.25 + 0.75 * look.lit[..., None])
    return np.round(255.0 * np.where(look.mask[..., None], colours, 1.0)).astype(np.uint8)


def depth_picture(depth: Float[np.ndarray, "h w"], low: float, high: float) -> UInt8[np.ndarray, "h w 3"]:
    """Near (`low`) is bright, far dark; white where there is none."""
    colours = mpl.colormaps["viridis_r"].with_extremes(bad="white")
    return colours(Normalize(low, high)(depth), bytes=True)[..., :3]


def depth_range(images: Iterable[Float[np.ndarray, "_ _"]]) -> tuple[float, float]:
    """The least and the greatest depth in some images; not empty."""
    found = np.concatenate([image[np.isfinite(image)] for image in images])
    return (float(found.min()), float(found.max())) if found.size else (0.0, 1.0)


class Tile(NamedTuple):
    """A small picture, and what it is."""

    name: str
    picture: UInt8[np.ndarray, "h w 3"]


def looks(seen: Imagined) -> list[Tile]:
    """The sampled surfaces from the chosen pose, and beside them what was then seen."""
    names = seen.names or tuple(f"imagined {number}" for number in range(1, len(seen.samples) + 1))
    tiles = [Tile(name, look_picture(sample, _UNSEEN)) for name, sample in zip(names, seen.samples, strict=True)]
    if seen.seen is None:
        return tiles
    return [*tiles, Tile("then seen", look_picture(seen.seen, NEW))]


def depths(seen: Imagined) -> tuple[list[Tile], str]:
    """Expected and seen depth, and their scale in words."""
    images = {"expected depth": seen.depth} | ({} if seen.seen is None else {"depth seen": seen.seen.depth})
    low, high = depth_range(images.values())
    tiles = [Tile(name, depth_picture(image, low, high)) for name, image in images.items()]
    scale = f"Depth from {low:.2f} (bright) to {high:.2f} scene units (dark); white: nothing there."
    error = None if seen.seen is None else depth_error(seen.depth, seen.seen.depth)
    return tiles, scale if error is None else f"{scale} Median error: {number(error)}."


def depth_error(expected: Float[np.ndarray, "h w"], seen: Float[np.ndarray, "i j"]) -> float | None:
    """Median of the difference where both say something, in scene units; None where their pixels do not compare."""
    # Pixels of the coarser image lie at the middle of those of the finer one.
    down, across = (max(fine // coarse, 1) for fine, coarse in zip(expected.shape, seen.shape, strict=True))
    expected = expected[down // 2 :: down, across // 2 :: across]
    if expected.shape != seen.shape or not np.isfinite(expected - seen).any():
        return None
    return float(np.nanmedian(np.abs(expected - seen)))
