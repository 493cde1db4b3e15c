"""Registration of a partial scan with a triangle mesh of the same size: iterative closest points from many starts.

A motion x -> R x + t takes the points p and normals n of the scan to the mesh. With c the nearest point of the mesh and
m its normal, a Gauss-Newton step reduces

    sum_p w (m . (R p + t - c))^2,    w = max(m . R n, 0) / (1 + |R p + t - c|^2 / s^2)

(Chen and Medioni 1992, with Cauchy weights). The scale s falls from step to step. The mean of w is the fit of the
motion, at best 1. Lengths are in units of the diagonal of the mesh's bounding box.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxnbv.errors import optional
from jaxnbv.scanning.sdf.sampled import winding_number
from jaxnbv.surfaces.placement import FreeRotation

# Number of rotations to start from, shifts for each, and points of the mesh used until motions are nearly right.
_ROTATIONS, _PLACES, _SAMPLES = 400, 3, 4000
# Points of the scan in each stage, scales of its steps, and number of motions kept for the next.
_FIRST, _SECOND, _THIRD, _LAST = 64, 400, 1000, 20_000
_SCALES = np.geomspace(0.1, 0.03, 8), np.geomspace(0.05, 0.01, 12), np.geomspace(0.02, 0.003, 12)
_KEPT_FIRST, _KEPT_SECOND, _ROUNDS = 40, 6, 12
# Scale in medians of the distances, smallest scale, damping relative to the trace of the normal equations, and the
# largest step.
_MEDIANS, _LEAST, _DAMPING, _LARGEST_STEP = 2.0, 1e-9, 1e-5, 0.5
# Motions that differ by less than this angle (as a cosine) and this shift count as one.
_SAME_TURN, _SAME_SHIFT = np.cos(np.radians(10.0)), 0.05
# Turns about the axis that the scan determines least: an almost round part has a local optimum at many of them.
_TURNS = 72
# A motion is a rival of the best if it has this share of its fit, and its mesh lies this far away on average.
_RIVAL, _ELSEWHERE = 0.97, 0.01

Nearest = Callable[[Float[np.ndarray, "n 3"]], tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]]
"""A function from points to the nearest points of a mesh, and the normals there."""


class Registration(NamedTuple):
    """Result of `register_scan`, lengths in units of the mesh.

    - `matrix`: the motion from the scan to the mesh.
    - `median`: median distance of the scan from the mesh.
    - `rival`: mean distance of the mesh from its place under another motion of nearly the same fit; 0 without one.
    """

    matrix: Float[np.ndarray, "4 4"]
    median: float
    rival: float


class _Motions(NamedTuple):
    turns: Float[np.ndarray, "s 3 3"]
    shifts: Float[np.ndarray, "s 3"]

    def at(self, rows: Sequence[int]) -> "_Motions":
        return _Motions(self.turns[rows], self.shifts[rows])


class _Equations(NamedTuple):
    """Normal equations of a step for each motion.

    - `gaps`: distances of the points from the surface.
    - `agreement`: agreement of the normals, from 0 to 1.
    """

    matrix: Float[np.ndarray, "s 6 6"]
    vector: Float[np.ndarray, "s 6"]
    gaps: Float[np.ndarray, "s n"]
    agreement: Float[np.ndarray, "s n"]

    def fit(self, scale: float) -> Float[np.ndarray, " s"]:
        return np.mean(self.agreement / (1.0 + (self.gaps / scale) ** 2), axis=1)


class _Stage(NamedTuple):
    """Points and normals of a scan, and the surface that they are registered to."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    nearest: Nearest
    is_solid: bool

    def equations(self, motions: _Motions, scale: float | None = None) -> _Equations:
        """Normal equations at a scale, by default twice the median distance of each motion."""
        arms = np.einsum("nj,sij->sni", self.points, motions.turns)
        places = arms + motions.shifts[:, None]
        feet, outer = (rows.reshape(places.shape) for rows in self.nearest(places.reshape(-1, 3)))
        agreement = np.sum(np.einsum("nj,sij->sni", self.normals, motions.turns) * outer, axis=-1)
        agreement = np.clip(agreement if self.is_solid else np.abs(agreement), 0.0, 1.0)
        gaps = np.linalg.norm(places - feet, axis=-1)
        scales = np.median(gaps, axis=1, keepdims=True) * _MEDIANS if scale is None else np.asarray(scale)
        weight = agreement / (1.0 + (gaps / np.maximum(scales, _LEAST)) ** 2)
        rows = np.concatenate([np.cross(arms, outer), outer], axis=-1)
        matrix = np.einsum("sni,snj->sij", weight[..., None] * rows, rows, optimize=True)
        vector = np.einsum("sn,sni->si", weight * np.sum((places - feet) * outer, axis=-1), rows)
        return _Equations(matrix, vector, gaps, agreement)

    def aligned(self, motions: _Motions, scales: Sequence[float | None] | np.ndarray) -> _Motions:
        """The motions after a damped step at each scale."""
        for scale in scales:
            matrix, vector, *_ = self.equations(motions, scale)
            damping = _DAMPING * np.trace(matrix, axis1=1, axis2=2) + 1e-12
            step = -np.linalg.solve(matrix + damping[:, None, None] * np.eye(6), vector[..., None])[..., 0]
            step *= np.minimum(1.0, _LARGEST_STEP / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))
            turns = Rotation.from_rotvec(step[:, :3]).as_matrix() @ motions.turns
            motions = _Motions(turns, motions.shifts + step[:, 3:])
        return motions

    def best(self, motions: _Motions, scale: float, count: int) -> _Motions:
        """The `count` motions of best fit that differ from all better ones."""
        rows: list[int] = []
        for row in np.argsort(-self.equations(motions, scale).fit(scale), kind="stable").tolist():
            cosine = 0.5 * (np.einsum("kij,ij->k", motions.turns[rows], motions.turns[row]) - 1.0)
            shift = np.linalg.norm(motions.shifts[rows] - motions.shifts[row], axis=1)
            if not np.any((cosine > _SAME_TURN) & (shift < _SAME_SHIFT)):
                rows.append(row)
            if len(rows) == count:
                break
        return motions.at(rows)

    def swept(self, motion: _Motions) -> _Motions:
        """One motion followed by turns about the axis that changes the fit least, in general a screw axis."""
        weakest = np.linalg.eigh(self.equations(motion).matrix[0])[1][:, 0]
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), weakest[:3]), weakest[3:]
        angles = np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False) / max(float(np.linalg.norm(weakest[:3])), 1e-3)
        screws = scipy.linalg.expm(angles[:, None, None] * twist)
        return _Motions(screws[:, :3, :3] @ motion.turns, screws[:, :3, 3] + motion.shifts)


def orient_outward(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, bool]:
    """Clean a mesh and wind its faces outward, and return whether it has an inside.

    Duplicate vertices and faces of zero area are removed. Winding numbers on both sides of the surface distinguish a
    solid, which may have holes, from a sheet. A sheet keeps its winding.
    """
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.area_faces > 1e-14 * mesh.scale**2)
    mesh.remove_unreferenced_vertices()
    if not mesh.is_winding_consistent:
        mesh.faces = optional("igl").bfs_orient(np.ascontiguousarray(mesh.faces, np.int64))[0]
    points, rows = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    step = 1e-4 * mesh.scale * mesh.face_normals[rows]
    inner, outer = (np.abs(winding_number(at, mesh.vertices, mesh.faces)) for at in (points - step, points + step))
    inside = float(np.mean(inner - outer))
    if inside < -0.5:
        # `Trimesh.invert` does not update the normals.
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    return mesh, abs(inside) > 0.5


def register_scan(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    mesh: trimesh.Trimesh,
    is_solid: bool,
    start: Float[np.ndarray, "4 4"] | None = None,
) -> Registration:
    """Find the motion that registers points with outward normals to a mesh.

    - `mesh`, `is_solid`: the results of `orient_outward`. The normals of a sheet may point to either side.
    - `start`: motion from the scan to the mesh to start from; without it, the search is over all motions.
    """
    unit, center, middle = mesh.scale, points.mean(axis=0), mesh.bounds.mean(axis=0)
    order = np.random.default_rng(0).permutation(len(points))[:_LAST]
    scan, directions = (points[order] - center) / unit, normals[order]
    samples, rows = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    samples = (samples - middle) / unit
    by_samples = _nearest_sample(samples, mesh.face_normals[rows])
    by_faces = _nearest_point((mesh.vertices - middle) / unit, mesh)
    counts, near = (_FIRST, _SECOND, _SECOND, _THIRD, _LAST), (by_samples, by_samples, by_faces, by_faces, by_faces)
    first, second, sweep, third, last = (
        _Stage(scan[:count], directions[:count], one, is_solid) for count, one in zip(counts, near, strict=True)
    )
    coarse, middling, fine = _SCALES
    if start is None:
        motions = first.best(first.aligned(_starts(scan, directions, samples), coarse), coarse[-1], _KEPT_FIRST)
        motions = second.best(second.aligned(motions, middling), middling[-1], _KEPT_SECOND)
        motions = third.aligned(motions, fine)
        around = sweep.aligned(sweep.swept(third.best(motions, fine[-1], 1)), 4 * [fine[-1]])
        both = zip(motions, sweep.best(around, fine[-1], _KEPT_SECOND), strict=True)
        motions = third.aligned(_Motions(*map(np.concatenate, both)), 4 * [None])
    else:
        motions = _Motions(start[None, :3, :3], (start[None, :3, :3] @ center + start[None, :3, 3] - middle) / unit)
        motions = third.aligned(second.aligned(motions, middling), fine)
    equations = third.equations(motions)
    fit = equations.fit(max(_MEDIANS * float(np.median(equations.gaps, axis=1).min()), _LEAST))
    winner, *others = np.argsort(-fit, kind="stable").tolist()
    rivals = [motions.at([row]) for row in others if fit[row] > _RIVAL * fit[winner]]
    rival = max((_apart(motions.at([winner]), other, samples, by_faces) for other in rivals), default=0.0)
    motions = last.aligned(motions.at([winner]), _ROUNDS * [None])
    matrix = np.eye(4)
    matrix[:3, :3] = motions.turns[0]
    matrix[:3, 3] = unit * motions.shifts[0] + middle - motions.turns[0] @ center
    median = unit * float(np.median(last.equations(motions).gaps))
    return Registration(matrix, median, unit * rival if rival > _ELSEWHERE else 0.0)


def _nearest_sample(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Nearest:
    tree = cKDTree(points)

    def nearest(places):
        _, rows = tree.query(places)
        return points[rows], normals[rows]

    return nearest


def _nearest_point(vertices: Float[np.ndarray, "v 3"], mesh: trimesh.Trimesh) -> Nearest:
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(mesh.faces, np.int64)
    tree = optional("igl").AABB()
    tree.init(vertices, faces)

    def nearest(places):
        _, rows, feet = tree.squared_distance(vertices, faces, np.ascontiguousarray(places))
        return feet, mesh.face_normals[rows]

    return nearest


def _starts(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], samples: Float[np.ndarray, "m 3"]
) -> _Motions:
    """Rotations, each with some shifts that put the scan inside the mesh's box.

    The first shift lays the scan on the front of the mesh along the mean normal.
    """
    turns = FreeRotation().rotations(_ROTATIONS)
    views = np.einsum("nj,sij->sni", points[:_THIRD], turns)
    low, high = views.min(axis=1), views.max(axis=1)
    least, most = samples.min(axis=0) - low, samples.max(axis=0) - high
    ahead = turns @ trimesh.unitize(normals.mean(axis=0) + 1e-12)
    front = (samples @ ahead.T).max(axis=0) - np.einsum("sni,si->sn", views, ahead).max(axis=1)
    central = 0.5 * (least + most)
    first = central + ahead * (front - np.sum(central * ahead, axis=1))[:, None]
    shares = np.random.default_rng(0).random((_PLACES - 1, _ROTATIONS, 3))
    return _Motions(np.tile(turns, (_PLACES, 1, 1)), np.concatenate([first, *(least + shares * (most - least))]))


def _apart(first: _Motions, second: _Motions, samples: Float[np.ndarray, "m 3"], nearest: Nearest) -> float:
    """Mean distance between the mesh placed relative to the scan by one motion, and by another."""
    moved = (samples - second.shifts[0]) @ second.turns[0] @ first.turns[0].T + first.shifts[0]
    return float(np.mean(np.linalg.norm(moved - nearest(moved)[0], axis=1)))
