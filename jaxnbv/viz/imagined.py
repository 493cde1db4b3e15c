"""What a step imagined: sampled surfaces as the chosen camera would see them, and the depth that was expected there."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Episode, View, observe_scene, view_keys
from jaxnbv.scanning import Evidence, GridSurface, TriangleMesh, mean_depth, scan
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.search import Proposal
from jaxnbv.surfaces import KnownShapesPosterior, SurfacePosterior
from jaxnbv.viz.sphere import unit

SHOWN = 4
_PIXELS = 96
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


class Expected(eqx.Module):
    """The depth that a camera was expected to measure, and what it measured or, not taken, would have.

    - `expected`: mean over the samples that a ray hits, NaN where it misses most.
    - `seen`: NaN where the ray met nothing; None where that is not known. It may have other pixels.
    """

    expected: Float[np.ndarray, "h w"]
    seen: Float[np.ndarray, "i j"] | None


class Imagined(eqx.Module):
    """What a step knew of its view before it was taken.

    - `samples`: some of its sampled surfaces, from the chosen pose.
    - `seen`: what was then seen from there; None where that is no image.
    - `chosen`, `runner_up`: of the chosen camera and of the best of the other candidates; None without one.
    - `names`: the known shape that each of `samples` is about; `kinds`: what it may be, and how likely that is. Both
      are empty where no shapes are known.
    """

    samples: tuple[Look, ...]
    seen: Look | None
    chosen: Expected
    runner_up: Expected | None
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
    other = runner_up(view.proposal) if planner.quantity.smooth else None
    poses = [view.pose] if other is None else [view.pose, other]
    camera, cloud = _finer(planner.camera), evidence.cloud.to_numpy()[0]
    scans = _scans(surfaces, camera, jax.tree.map(lambda *rows: np.stack(rows), *poses), planner.imagination)
    count = min(SHOWN, planner.imagination.num_samples)
    samples = tuple(look(_rows(scans, (sample, 0)), camera, view.pose, cloud) for sample in range(count))
    expected = [
        np.asarray(mean_depth(_rows(scans, (slice(None), i)), pose), np.float64).reshape(camera.height, camera.width)
        for i, pose in enumerate(poses)
    ]
    taken = taken_look(view, cloud)
    beside = None if other is None else Expected(expected[1], _depth(_not_taken(episode, view, other, cloud)))
    names: tuple[str, ...] = ()
    kinds: tuple[tuple[str, float], ...] = ()
    if isinstance(posterior, KnownShapesPosterior):
        names = tuple(posterior.names_of_samples(sample_key, planner.imagination.num_samples)[:count])
        kinds = tuple(posterior.kinds().items())
    return Imagined(samples, taken, Expected(expected[0], _depth(taken)), beside, names, kinds)


def _scans(surfaces: GridSurface, camera: Camera, poses: Pose, imagination: Imagination) -> PointCloud:
    """What the camera sees of each of s surfaces from each of p poses: clouds with leading axes (s, p).

    Of triangles: a picture is no reason to compile a scan of so many pixels.
    """
    barrier, found = imagination.barrier(camera, poses), []
    for values in np.array(surfaces.values):
        triangles = level_triangles(values, imagination.grid)
        if triangles is not None:
            found.append(scan(TriangleMesh(*triangles[:2], Frame()), camera, poses, barrier))
            continue
        misses = jnp.ones((*poses.position.shape[:-1], camera.num_rays), bool)
        nowhere = jnp.zeros((*misses.shape, 3))
        found.append(PointCloud(nowhere, nowhere, ~misses, misses))
    return jax.tree.map(lambda *rows: np.stack(rows), *found)


def _depth(seen: Look | None) -> Float[np.ndarray, "h w"] | None:
    return None if seen is None else seen.depth


def runner_up(proposal: Proposal) -> Pose | None:
    """The best open candidate but the chosen one; None if there is no other."""
    values = np.asarray(proposal.values, np.float64)
    same = np.linalg.norm(np.asarray(proposal.candidates.position) - np.asarray(proposal.pose.position), axis=1) < 1e-6
    values = np.where(np.isfinite(values) & ~same, values, -np.inf)
    best = int(values.argmax())
    return None if values[best] == -np.inf else proposal.candidates[best]


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


def _not_taken(episode: Episode, view: View, pose: Pose, cloud: Float[np.ndarray, "n 3"]) -> Look | None:
    """What the sensor of a view would have seen from another pose; None where the scene is not known."""
    if episode.scene is None or episode.noise is None:
        return None
    around = episode.planner.imagination.surroundings
    seen = observe_scene(episode.scene, view.camera, pose, episode.noise, episode.key, around)
    return look(seen, view.camera, pose, cloud)


def _rows(scans: PointCloud, at: tuple) -> PointCloud:
    return jax.tree.map(lambda rows: rows[at], scans)
