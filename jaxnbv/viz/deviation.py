"""Inspection: distances of a scan from its CAD model, the worst places, and the surface that was not scanned."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from jaxnbv.checks import AnyArray, as_numbers, checked, require, short_text
from jaxnbv.errors import explained_imports, optional
from jaxnbv.geometry.cloud import PointCloud, check_single
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import rigid_matrices
from jaxnbv.scanning.mesh import TriangleMesh
from jaxnbv.scanning.mesh_files import read_nodes
from jaxnbv.scanning.sdf.sampled import checked_triangles
from jaxnbv.surfaces.rigid import orient_outward, register_scan

# Number of points sampled from a scanned mesh, least number of points of a cloud, and number of tested CAD points.
_POINTS, _MIN_POINTS, _SAMPLES = 50_000, 10, 20_000
# A scan that is this many times larger or smaller than the CAD must be in different units.
_LARGE_RATIO, _SMALL_RATIO = 8.0, 50.0
# Fractions of the CAD's diameter: least distance between two worst places, largest deviation of a point that covers the
# CAD, and median distance above which the fit is poor.
_MIN_DISTANCE, _MAX_DISTANCE, _POOR_MEDIAN = 0.05, 0.05, 0.02
# Number of nearest points over which a median smooths the deviation.
_NEIGHBOURS = 9
# A place on the CAD is covered if at least this many points lie within a radius. The radius is the second number times
# the distance from a point to its fourth neighbour. The cosine between the normals of place and point must exceed the
# third number.
_MIN_COVERING, _RADIUS, _MIN_COSINE = 3, 1.5, 0.3
# Numbered places have at least this many times the median deviation. Largest deviation of the colour scale if the scan
# does not deviate at all.
_MIN_OUTLIER_RATIO, _MIN_LIMIT = 4.0, 1e-9

_Mesh: TypeAlias = trimesh.Trimesh | trimesh.Scene | str | Path


class WorstPlace(NamedTuple):
    """A local extreme of the deviation, in the coordinates and units of the scan.

    - `position`: a point of the scan.
    - `distance`: signed distance from the CAD, the median over the nine points nearest to `position`.
    - `extent`: diameter of the connected region around `position` where the deviation is at least half as large.
    """

    position: Float[np.ndarray, "3"]
    distance: float
    extent: float


class Deviation(eqx.Module):
    """Signed distances of a scan from its CAD model, in the coordinates and units of the scan.

    - `pose`: pose of the CAD, from its coordinates to the scan's.
    - `points`: points of the scan, uniform by area if it is a mesh.
    - `distances`: signed distance from the CAD to each point, positive outside (too much material).
    - `nearest_points`, `normals`: for each point, the nearest point of the CAD and its outward normal.
    - `cad`: the CAD at this pose.
    - `area`, `missing_area`: areas of the CAD that the scan covers and does not cover.
    - `imagined`: fraction of the scanned mesh's area that no view measured. This area is not compared.
    - `radius`: a place on the CAD is covered if at least three of the four nearest rows of `nearest_points` are within
      this distance and on the same side of the wall, as their normals show.
    """

    pose: Float[np.ndarray, "4 4"]
    points: Float[np.ndarray, "n 3"]
    distances: Float[np.ndarray, " n"]
    nearest_points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    cad: TriangleMesh
    area: float
    missing_area: float
    imagined: float
    radius: float

    @property
    def median(self) -> float:
        """Median of the absolute distances."""
        return self.percentile(50.0)

    @checked
    def percentile(self, share: float) -> float:
        """Return the absolute distance that `share` percent of the points do not exceed.

        **Raises:** `ValueError` for a share outside [0, 100].
        """
        require(0 <= share <= 100, f"the share is {share} percent; give a number from 0 to 100")
        return float(np.percentile(np.abs(self.distances), share))

    @checked
    def worst(self, count: int = 5, min_distance: float | None = None) -> tuple[WorstPlace, ...]:
        """Return at most `count` places with the largest deviations, the worst first.

        Two extremes count as one place if the deviation between them stays above half of the smaller extreme.

        - `min_distance`: least distance between two places; 5 % of the CAD's diameter by default.

        **Raises:** `ValueError` for a count below 1 or a negative distance.
        """
        require(count >= 1, f"the number of places is {count}; ask for at least one")
        min_distance = _MIN_DISTANCE * _diameter(self.cad.vertices) if min_distance is None else min_distance
        require(min_distance >= 0, f"places are {min_distance} apart; give a positive length")
        tree = cKDTree(self.points)
        _, near = tree.query(self.points, k=_NEIGHBOURS)
        smooth = np.median(self.distances[near], axis=1)
        size, num = np.abs(smooth), len(smooth)
        edges = np.repeat(np.arange(num), _NEIGHBOURS - 1), near[:, 1:].ravel()
        graph = coo_array((np.ones(len(edges[0]), bool), edges), (num, num)).tocsr()
        places, rows, is_candidate = list[WorstPlace](), list[int](), np.ones(num, bool)
        while len(places) < count and is_candidate.any():
            row = int(np.argmax(np.where(is_candidate, size, -1.0)))
            high = np.flatnonzero((size >= 0.5 * size[row]) & (np.sign(smooth) == np.sign(smooth[row])))
            _, labels = connected_components(graph[high][:, high], directed=False)
            region = high[labels == labels[np.searchsorted(high, row)]]
            is_candidate[region] = False
            if not np.isin(rows, region).any():
                rows.append(row)
                is_candidate[tree.query_ball_point(self.points[row], min_distance)] = False
                places.append(WorstPlace(self.points[row], float(smooth[row]), _diameter(self.points[region])))
        return tuple(places)

    def values_at(self, places: Float[np.ndarray, "m 3"], normals: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " m"]:
        """Return the signed distances of the scan from the CAD at places on the CAD, NaN where not covered.

        A scan of one side of a wall does not cover the other side.

        - `places`, `normals`: points of `cad` and the outward normals there.
        """
        rows = np.flatnonzero(np.abs(self.distances) < _MAX_DISTANCE * _diameter(self.cad.vertices))
        if len(rows) == 0:
            return np.full(len(places), np.nan)
        gaps, near = cKDTree(self.nearest_points[rows]).query(places, k=[1, 2, 3, 4], distance_upper_bound=self.radius)
        near = rows[np.minimum(near, len(rows) - 1)]
        is_facing = np.einsum("mki,mi->mk", self.normals[near], normals) > _MIN_COSINE
        is_near = np.isfinite(gaps) & is_facing
        weight = np.where(is_near, 1.0 / (np.where(is_near, gaps, 0.0) + 0.1 * self.radius), 0.0)
        mean = np.sum(weight * self.distances[near], axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
        return np.where(is_near.sum(axis=1) >= _MIN_COVERING, mean, np.nan)

    @checked
    def figure(
        self,
        unit: str = "units of the scan",
        scale: float = 1.0,
        limit: float | None = None,
        count: int = 5,
        up: str = "z",
    ) -> Any:
        """Draw the CAD from two sides, coloured by the deviation, and return the matplotlib `Figure`.

        The CAD is grey where it was not scanned. Numbers mark the worst place, and the next places whose deviation is
        at least four times the median.

        - `unit`: name of the unit of the colours.
        - `scale`: factor from the scan's unit to `unit`: 1000 for millimetres if the scan is in metres.
        - `limit`: deviation at the ends of the colours, in `unit`. By default the deviation of the worst place.
        - `count`: maximum number of numbered places.
        - `up`: upward axis of the scan, see `Frame`.

        **Raises:** `ValueError` for a scale or limit that is not positive, an unknown axis, or if matplotlib is
        missing.
        """
        with explained_imports():
            from jaxnbv.viz.deviation_figure import Mark, deviation_figure
        require(scale > 0, f"the scale is {scale}; it must be positive")
        first, *others = self.worst(count)
        places = [first, *(place for place in others if abs(place.distance) >= _MIN_OUTLIER_RATIO * self.median)]
        distances = [scale * place.distance for place in places]
        limit = max(abs(distances[0]), _MIN_LIMIT) if limit is None else limit
        require(limit > 0, f"the colours end at {limit}; give a positive deviation")
        _, rows = cKDTree(self.points).query([place.position for place in places])
        middle, upper = (scale * self.percentile(percent) for percent in (50.0, 90.0))
        missing = 100.0 * self.missing_area / (self.area + self.missing_area)
        caption = f"median {middle:.3g},  90 % within {upper:.3g};  {missing:.0f} % of the CAD not scanned"
        marks = [Mark(*mark) for mark in zip(self.nearest_points[rows], self.normals[rows], distances, strict=True)]
        return deviation_figure(
            self.cad, lambda *arguments: scale * self.values_at(*arguments), marks, limit, unit, caption, up
        )


@checked
def deviation(
    mesh: trimesh.Trimesh | trimesh.Scene | PointCloud | str | Path,
    cad: trimesh.Trimesh | trimesh.Scene | TriangleMesh | str | Path,
    pose: Float[AnyArray, "4 4"] | list | None = None,
    register: bool = True,
) -> Deviation:
    """Compare a scanned surface, or a part of it, with a CAD model in the same units.

    The CAD is aligned with the scan by iterative closest points. For a symmetric CAD several poses are equally good.
    Distances are to the nearest surface, so a dent deeper than half of a wall is measured from the wall's other side.

    - `mesh`: the scan: a mesh whose faces are wound outward, the file of such a mesh, or a cloud with outward normals.
      In meshes of `surface_mesh` and PLY files of `save_mesh`, only the faces marked as measured are compared.
    - `cad`: the CAD model, which need not be closed. The outside of a sheet is where the normals of its faces point.
    - `pose`: pose of the CAD (from its coordinates to the scan's) at which the alignment starts, such as
      `session.object_pose.matrix`. By default all rotations are tried.
    - `register`: False to leave the CAD at `pose`, by default the identity.

    A `UserWarning` says if no pose fits well, or if other poses fit nearly as well.

    **Raises:** `ValueError` for a file that cannot be read, a mesh without faces, a scan of fewer than ten points or
    without measured faces, a pose that is not rigid, units that differ, or if libigl is missing.
    """
    model, is_solid = orient_outward(_mesh_of(cad))
    points, normals, imagined = _points_of(mesh)
    _check_units(_diameter(points), _diameter(model.vertices))
    matrix = _rigid_matrix(pose)
    if register:
        start = None if pose is None else np.linalg.inv(matrix)
        result = register_scan(points, normals, model, is_solid, start)
        if result.median_distance > _POOR_MEDIAN * _diameter(model.vertices):
            warnings.warn(
                f"the CAD fits the scan poorly: the median distance is {result.median_distance:.4g}. Give pose=, and "
                "check that it is this part, that the scan shows little else, and that its faces are wound outward",
                stacklevel=3,
            )
        if result.ambiguity > 0:
            warnings.warn(
                "the CAD fits the scan nearly as well in another pose, where its surface is off by "
                f"{result.ambiguity:.4g} on average: scan more of the part, or give pose=",
                stacklevel=3,
            )
        matrix = np.linalg.inv(result.matrix)
    rotation, faces = matrix[:3, :3], np.ascontiguousarray(model.faces, np.int64)
    vertices = np.ascontiguousarray(model.vertices @ rotation.T + matrix[:3, 3])
    # Pseudonormals give a sign on open meshes too, where winding numbers have no inside.
    igl = optional("igl")
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distances, rows, nearest_points, _ = igl.signed_distance(np.ascontiguousarray(points), vertices, faces, kind)
    gaps, _ = cKDTree(points).query(points, k=5)
    radius, outer_normals = _RADIUS * float(np.quantile(gaps[:, 4], 0.9)), model.face_normals @ rotation.T
    posed_cad, area = TriangleMesh(vertices, faces, Frame()), float(model.area)
    nearest = nearest_points, outer_normals[rows]
    all_covered = Deviation(matrix, points, distances, *nearest, posed_cad, area, 0.0, imagined, radius)
    samples, rows = trimesh.sample.sample_surface(posed_cad.to_trimesh(), _SAMPLES, seed=0)
    missing = area * float(np.mean(np.isnan(all_covered.values_at(np.asarray(samples), outer_normals[rows]))))
    return dataclasses.replace(all_covered, area=area - missing, missing_area=missing)


def _mesh_of(source: _Mesh | TriangleMesh) -> trimesh.Trimesh:
    """Convert a mesh to trimesh in its own units, and keep its face attribute `measured` if it has one."""
    if isinstance(source, TriangleMesh):
        return trimesh.Trimesh(source.frame.to_world(source.vertices), source.faces, process=False)
    parts = [part for _, part in read_nodes(source)]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    corners = [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
    vertices, faces = checked_triangles(np.concatenate([part.vertices for part in parts]), np.concatenate(corners))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    require(mesh.area > 0, f"all {len(faces)} faces of the mesh have zero area: there is no surface")
    marks: Any = None
    if isinstance(source, trimesh.Trimesh):
        marks = source.face_attributes.get("measured")
    elif isinstance(source, str | Path) and Path(source).suffix.lower() == ".ply":
        raw = trimesh.load(source, process=False).metadata.get("_ply_raw", {}).get("face", {}).get("data")
        marks = raw["measured"] if "measured" in (getattr(raw, "dtype", np.dtype(int)).names or ()) else None
    if marks is not None and len(marks) == len(faces):
        mesh.face_attributes["measured"] = np.asarray(marks).astype(bool)
    return mesh


def _points_of(scan: _Mesh | PointCloud) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], float]:
    """Return measured points of a scan, their normals, and the fraction of the scan's area that was imagined."""
    if isinstance(scan, PointCloud):
        check_single(scan)
        points, normals = (rows.astype(np.float64) for rows in scan.to_numpy())
        require(len(points) >= _MIN_POINTS, f"the scan has {len(points)} points: give at least {_MIN_POINTS}")
        require(bool(np.isfinite(points).all()), "the scan has points that are not finite: drop them")
        return points, normals, 0.0
    mesh = _mesh_of(scan)
    is_measured = mesh.face_attributes.get("measured", np.ones(len(mesh.faces), bool))
    weight = np.where(is_measured, mesh.area_faces, 0.0)
    require(weight.sum() > 0, f"none of the {len(mesh.faces)} faces of the scan was measured: add a view")
    points, rows = trimesh.sample.sample_surface(mesh, _POINTS, face_weight=weight, seed=0)
    return np.asarray(points), mesh.face_normals[rows], max(0.0, 1.0 - float(weight.sum() / mesh.area))


def _check_units(scan: float, cad: float) -> None:
    ratio = max(scan, cad) / max(min(scan, cad), 1e-30)
    require(
        ratio < (_LARGE_RATIO if scan > cad else _SMALL_RATIO),
        f"the scan is {scan:.4g} across and the CAD {cad:.4g}, a factor of {ratio:.3g}: their units differ, such as "
        "millimetres and metres (1000). Scale one, as by cad.apply_scale(0.001), or crop the scan to the part",
    )


def _rigid_matrix(pose: Float[AnyArray, "4 4"] | list | None) -> Float[np.ndarray, "4 4"]:
    """Check that a pose is a rigid (4, 4) matrix, and convert None to the identity."""
    matrix = np.eye(4) if pose is None else as_numbers(pose, "the pose", np.float64)
    shape = matrix.shape
    require(shape == (4, 4), f"the pose has shape {shape}: give a matrix (4, 4), from the CAD to the scan")
    (matrix,), (is_rigid,) = rigid_matrices(matrix[None])
    require(is_rigid, f"the pose is no rigid motion: {short_text(pose)}; give a rotation and a shift, [[R, t], [0, 1]]")
    return matrix


def _diameter(points: Float[np.ndarray, "n 3"]) -> float:
    """Return the approximate distance between the two points that are farthest apart."""
    farthest = points[np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    return float(np.linalg.norm(points - farthest, axis=1).max())
