"""Exports the points and the surface of an episode, in world units."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxnbv.checks import InputError, checked, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.planning.episode import Episode
from jaxnbv.sampler import StepInputs
from jaxnbv.storage.files import write_bytes
from jaxnbv.storage.run_folder import ply_of
from jaxnbv.surfaces.known_shapes import KnownShapesPosterior
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.viz.mean_surface import MeanSurface, mean_surface, near_points
from jaxnbv.viz.placed_shape import likeliest_part, likely_kinds

_CLOUD_FORMATS, _MESH_FORMATS = ("ply", "obj", "glb", "xyz"), ("ply", "obj", "glb", "stl", "off")


@checked
def scanned_cloud(episode: Episode) -> PointCloud:
    """Return all points that the views measured on the object, in world units.

    The points have the resolution of the scans. `Episode.cloud` has only the points that planning keeps.

    **Raises:** `ValueError` for an episode without views.
    """
    require(len(episode.views) > 0, "the episode has no view yet: there are no points")
    scans = zip(*(view.scan.to_numpy() for view in episode.views), strict=True)
    points, normals = map(np.concatenate, scans)
    return episode.frame.to_world(PointCloud.from_arrays(points, normals))


@checked
def surface_mesh(episode: Episode, imagined: bool = True) -> trimesh.Trimesh:
    """Return the surface after the last view, in world units.

    It is the surface of the posterior mean. With known shapes, it is the mean given that the shape in the
    report's picture is right, and for parts at true size the likeliest part.

    - `imagined`: whether to keep surface that no view measured.

    `vertex_attributes["deviation"]` is the standard deviation of each vertex along its normal.
    `face_attributes["measured"]` is 1 if each vertex of a face is within one grid spacing of a scanned point, else 0.

    **Raises:** `ValueError` for an episode without views, or whose grid holds no surface.
    """
    cloud = scanned_cloud(episode)
    planner, frame = episode.planner, episode.frame
    surface = _surface(episode)
    if surface is None:
        raise InputError("the sampler's grid holds no surface with points: give a finer one, or another view")
    vertices = np.asarray(frame.to_world(surface.vertices), np.float64)
    mesh = trimesh.Trimesh(vertices, surface.faces, process=False)
    distances, _ = cKDTree(cloud.to_numpy()[0]).query(vertices)
    cell = float(frame.length_to_world(planner.sampler.grid.spacing))
    mesh.vertex_attributes["deviation"] = np.asarray(frame.length_to_world(surface.deviation), np.float32)
    is_measured = (distances[mesh.faces] < cell).all(axis=1)
    mesh.face_attributes["measured"] = is_measured.astype(np.uint8)
    if not imagined:
        mesh.update_faces(is_measured)
        mesh.remove_unreferenced_vertices()
    return mesh


class Region(NamedTuple):
    """A connected part of the surface that no view measured, in world units.

    - `center`, `normal`: mean position and mean outward normal. To see the region, look against `normal`.
    - `area`, `radius`: area, and largest distance of a triangle of the region from `center`.
    """

    center: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    area: float
    radius: float


@checked
def missing_regions(episode: Episode, smallest: float = 0.0) -> list[Region]:
    """Return the connected parts of the expected surface that no view measured, the largest first.

    Surface near an obstacle, such as the table under the object, cannot be measured and does not count as missing.

    - `smallest`: area that a region must exceed, in squared world units.

    **Raises:** `ValueError` for an episode without views, or whose grid holds no surface.
    """
    mesh, planner, frame = surface_mesh(episode), episode.planner, episode.frame
    is_measured = np.asarray(mesh.face_attributes["measured"], bool)
    is_missing = ~is_measured
    if (obstacles := planner.obstacles) is not None:
        min_distance = obstacles.margin + planner.sampler.grid.spacing
        is_missing &= np.asarray(obstacles.distance(frame.to_scene(mesh.triangles_center))) > min_distance
    neighbours = mesh.face_adjacency[is_missing[mesh.face_adjacency].all(axis=1)]
    parts = trimesh.graph.connected_components(neighbours, nodes=np.flatnonzero(is_missing))
    regions = [_region(mesh, faces) for faces in parts]
    return sorted((region for region in regions if region.area > smallest), key=lambda region: -region.area)


def _region(mesh: trimesh.Trimesh, faces: Int[np.ndarray, " f"]) -> Region:
    areas, centers = mesh.area_faces[faces], mesh.triangles_center[faces]
    normal, area = areas @ mesh.face_normals[faces], float(areas.sum())
    center = areas @ centers / max(area, np.finfo(float).tiny)
    # The mean normal of a closed surface is zero.
    length = max(float(np.linalg.norm(normal)), np.finfo(float).tiny)
    return Region(center, normal / length, area, float(np.linalg.norm(centers - center, axis=1).max()))


@checked
def save_cloud(episode: Episode, path: str | Path) -> Path:
    """Write `scanned_cloud` to a PLY, OBJ, GLB or XYZ file, according to the suffix of `path`.

    Only a PLY file holds the normals.

    **Raises:** `ValueError` for an episode without views, for a different suffix, or if the file cannot be written.
    """
    cloud, kind = scanned_cloud(episode), _kind(path, _CLOUD_FORMATS)
    is_ply = kind == "ply"
    return _write(path, ply_of(cloud) if is_ply else trimesh.PointCloud(cloud.to_numpy()[0]).export(file_type=kind))


@checked
def save_mesh(episode: Episode, path: str | Path, imagined: bool = True) -> Path:
    """Write `surface_mesh` to a PLY, OBJ, GLB, STL or OFF file, according to the suffix of `path`.

    Only a PLY file holds the deviation of each vertex, and whether each face was measured.

    **Raises:** `ValueError` if `surface_mesh` does, for a different suffix, or if the file cannot be written.
    """
    kind = _kind(path, _MESH_FORMATS)
    return _write(path, surface_mesh(episode, imagined).export(file_type=kind))


def _surface(episode: Episode) -> MeanSurface | None:
    sampler, observations = episode.planner.sampler, episode.observations_after(len(episode.views))
    if isinstance(observations.hypotheses, PartHypotheses):
        return likeliest_part(observations.hypotheses)
    posterior = sampler.posterior(observations)
    if isinstance(posterior, KnownShapesPosterior):
        # The mean over several shapes looks like none of them. Use the shape that pictures show.
        answer = episode.views[-1].answer(episode.planner.acquisition)
        kinds = likely_kinds(posterior.model.bank, posterior.fits, posterior.weights, answer)
        posterior = posterior.given(kinds[0].row) if kinds else posterior.of_none
    return near_points(mean_surface(sampler, StepInputs(observations, posterior)), observations.cloud)


def _kind(path: str | Path, kinds: tuple[str, ...]) -> str:
    kind = Path(path).suffix[1:].lower()
    suffixes = ", ".join(f".{suffix}" for suffix in kinds)
    require(kind in kinds, f"{path} does not say a format: end it with one of {suffixes}")
    return kind


def _write(path: str | Path, content: Any) -> Path:
    write_bytes(Path(path), content.encode() if isinstance(content, str) else content)
    return Path(path)
