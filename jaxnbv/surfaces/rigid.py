"""Registration of a partial scan to a mesh of equal scale: iterative closest points from many starts.

A motion x -> R x + t maps the points p and normals n of the scan to the mesh. Let c be the point of the mesh nearest to
R p + t, and m the normal at c. A Gauss-Newton step reduces

    sum_p w (m . (R p + t - c))^2,    w = max(m . R n, 0) / (1 + |R p + t - c|^2 / s^2)

(Chen and Medioni 1992, with Cauchy weights). The scale s decreases from step to step. The mean of w, at most 1, is
called the fit of the motion. Lengths are in units of the diagonal of the mesh's bounding box.
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

# Number of initial rotations, of initial shifts per rotation, and of points sampled on the mesh. The sampled points
# replace the mesh in the first two stages.
_NUM_ROTATIONS, _NUM_SHIFTS, _NUM_SAMPLES = 400, 3, 4000
# Number of scan points in each stage.
_FIRST, _SECOND, _THIRD, _LAST = 64, 400, 1000, 20_000
# Scales s of the steps in the first three stages.
_SCALES = np.geomspace(0.1, 0.03, 8), np.geomspace(0.05, 0.01, 12), np.geomspace(0.02, 0.003, 12)
# Number of motions that the first and the second stage pass on, and number of steps in the last stage.
_BEST_FIRST, _BEST_SECOND, _NUM_LAST_STEPS = 40, 6, 12
# Default scale s as a multiple of the median distance, smallest scale, damping relative to the trace of the normal
# equations, and largest step.
_SCALE_PER_MEDIAN, _MIN_SCALE, _DAMPING, _MAX_STEP = 2.0, 1e-9, 1e-5, 0.5
# Motions that differ by less than this angle (stored as its cosine) and this shift count as equal.
_MIN_COSINE, _MAX_SHIFT = np.cos(np.radians(10.0)), 0.05
# Number of rotations tried about the axis that the scan constrains least. An almost round part has many local optima
# in rotation about its axis.
_SWEEP = 72
# A motion is a rival of the best motion if its fit is at least this fraction of the best fit, and if the two motions
# place the mesh at least this mean distance apart.
_MIN_FIT_RATIO, _MIN_AMBIGUITY = 0.97, 0.01

Nearest = Callable[[Float[np.ndarray, "n 3"]], tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]]
"""A function from points to the nearest points on a mesh, and the normals there."""


class Registration(NamedTuple):
    """Result of `register_scan`. Lengths are in the unit of the mesh.

    - `matrix`: the motion from the scan to the mesh.
    - `median_distance`: median distance of the scan's points from the mesh, after this motion.
    - `ambiguity`: mean distance between the mesh placed by `matrix` and the mesh placed by the most different motion
      that fits nearly as well. It is 0 if no such motion is clearly different.
    """

    matrix: Float[np.ndarray, "4 4"]
    median_distance: float
    ambiguity: float


class _Motions(NamedTuple):
    """Rigid motions x -> R x + t from the scan to the mesh, with rotations R and shifts t."""

    rotations: Float[np.ndarray, "s 3 3"]
    shifts: Float[np.ndarray, "s 3"]

    def take(self, rows: Sequence[int]) -> "_Motions":
        return _Motions(self.rotations[rows], self.shifts[rows])


class _Equations(NamedTuple):
    """Normal equations of one Gauss-Newton step for each motion: matrix @ step = -vector.

    - `gaps`: distances of the moved scan points from the surface.
    - `agreement`: cosines between the normals of the scan and of the mesh, clipped to [0, 1].
    """

    matrix: Float[np.ndarray, "s 6 6"]
    vector: Float[np.ndarray, "s 6"]
    gaps: Float[np.ndarray, "s n"]
    agreement: Float[np.ndarray, "s n"]

    def fit(self, scale: float) -> Float[np.ndarray, " s"]:
        return np.mean(self.agreement / (1.0 + (self.gaps / scale) ** 2), axis=1)


class _Stage(NamedTuple):
    """Scan points and normals of one stage, and the surface to which it registers them."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    nearest: Nearest
    is_solid: bool

    def equations(self, motions: _Motions, scale: float | None = None) -> _Equations:
        """Return the normal equations of the next Gauss-Newton step for each motion.

        - `scale`: distance from the surface at which a point's weight halves. The default is twice the median distance
          of the moved points.
        """
        arms = np.einsum("nj,sij->sni", self.points, motions.rotations)
        positions = arms + motions.shifts[:, None]
        feet, normals = (rows.reshape(positions.shape) for rows in self.nearest(positions.reshape(-1, 3)))
        agreement = np.sum(np.einsum("nj,sij->sni", self.normals, motions.rotations) * normals, axis=-1)
        agreement = np.clip(agreement if self.is_solid else np.abs(agreement), 0.0, 1.0)
        gaps = np.linalg.norm(positions - feet, axis=-1)
        scales = np.median(gaps, axis=1, keepdims=True) * _SCALE_PER_MEDIAN if scale is None else np.asarray(scale)
        weight = agreement / (1.0 + (gaps / np.maximum(scales, _MIN_SCALE)) ** 2)
        rows = np.concatenate([np.cross(arms, normals), normals], axis=-1)
        matrix = np.einsum("sni,snj->sij", weight[..., None] * rows, rows, optimize=True)
        vector = np.einsum("sn,sni->si", weight * np.sum((positions - feet) * normals, axis=-1), rows)
        return _Equations(matrix, vector, gaps, agreement)

    def align(self, motions: _Motions, scales: Sequence[float | None] | np.ndarray) -> _Motions:
        """Return the motions after damped Gauss-Newton steps, one for each entry of `scales`."""
        for scale in scales:
            matrix, vector, *_ = self.equations(motions, scale)
            damping = _DAMPING * np.trace(matrix, axis1=1, axis2=2) + 1e-12
            step = -np.linalg.solve(matrix + damping[:, None, None] * np.eye(6), vector[..., None])[..., 0]
            step *= np.minimum(1.0, _MAX_STEP / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))
            rotations = Rotation.from_rotvec(step[:, :3]).as_matrix() @ motions.rotations
            motions = _Motions(rotations, motions.shifts + step[:, 3:])
        return motions

    def best(self, motions: _Motions, scale: float, count: int) -> _Motions:
        """Return the `count` motions with the best fits, skipping any that nearly equals a better motion."""
        rows: list[int] = []
        for row in np.argsort(-self.equations(motions, scale).fit(scale), kind="stable").tolist():
            cosine = 0.5 * (np.einsum("kij,ij->k", motions.rotations[rows], motions.rotations[row]) - 1.0)
            shift = np.linalg.norm(motions.shifts[rows] - motions.shifts[row], axis=1)
            if not np.any((cosine > _MIN_COSINE) & (shift < _MAX_SHIFT)):
                rows.append(row)
            if len(rows) == count:
                break
        return motions.take(rows)

    def rotate_about_weakest_axis(self, motion: _Motions) -> _Motions:
        """Return copies of a motion, each turned about the screw axis that the scan constrains least."""
        weakest = np.linalg.eigh(self.equations(motion).matrix[0])[1][:, 0]
        twist = np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), weakest[:3]), weakest[3:]
        angles = np.linspace(0.0, 2.0 * np.pi, _SWEEP, endpoint=False) / max(float(np.linalg.norm(weakest[:3])), 1e-3)
        screws = scipy.linalg.expm(angles[:, None, None] * twist)
        return _Motions(screws[:, :3, :3] @ motion.rotations, screws[:, :3, 3] + motion.shifts)


def orient_outward(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, bool]:
    """Return a copy of a mesh with faces wound outward, and whether the mesh is a solid.

    Duplicate vertices and faces of zero area are removed. Winding numbers on both sides of the surface distinguish a
    solid, which may have holes, from a sheet. The normals of a sheet agree with each other, but may point to either
    side.
    """
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.area_faces > 1e-14 * mesh.scale**2)
    mesh.remove_unreferenced_vertices()
    if not mesh.is_winding_consistent:
        mesh.faces = optional("igl").bfs_orient(np.ascontiguousarray(mesh.faces, np.int64))[0]
    points, rows = trimesh.sample.sample_surface(mesh, _NUM_SAMPLES, seed=0)
    step = 1e-4 * mesh.scale * mesh.face_normals[rows]
    inner, outer = (np.abs(winding_number(x, mesh.vertices, mesh.faces)) for x in (points - step, points + step))
    difference = float(np.mean(inner - outer))
    if difference < -0.5:
        # `Trimesh.invert` does not update the normals.
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)
    return mesh, abs(difference) > 0.5


def register_scan(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    mesh: trimesh.Trimesh,
    is_solid: bool,
    start: Float[np.ndarray, "4 4"] | None = None,
) -> Registration:
    """Find the motion that registers points with outward normals to a mesh.

    - `mesh`, `is_solid`: the results of `orient_outward`. The normals of a sheet may point to either side.
    - `start`: initial motion from the scan to the mesh. Without it, the search covers all rotations.
    """
    unit, center, middle = mesh.scale, points.mean(axis=0), mesh.bounds.mean(axis=0)
    order = np.random.default_rng(0).permutation(len(points))[:_LAST]
    scan, directions = (points[order] - center) / unit, normals[order]
    samples, rows = trimesh.sample.sample_surface(mesh, _NUM_SAMPLES, seed=0)
    samples = (samples - middle) / unit
    by_samples = _nearest_sample(samples, mesh.face_normals[rows])
    by_faces = _nearest_point((mesh.vertices - middle) / unit, mesh)
    counts, near = (_FIRST, _SECOND, _SECOND, _THIRD, _LAST), (by_samples, by_samples, by_faces, by_faces, by_faces)
    first, second, sweep, third, last = (
        _Stage(scan[:count], directions[:count], one, is_solid) for count, one in zip(counts, near, strict=True)
    )
    coarse, middling, fine = _SCALES
    if start is None:
        motions = first.best(first.align(_initial_motions(scan, directions, samples), coarse), coarse[-1], _BEST_FIRST)
        motions = second.best(second.align(motions, middling), middling[-1], _BEST_SECOND)
        motions = third.align(motions, fine)
        rotated = sweep.align(sweep.rotate_about_weakest_axis(third.best(motions, fine[-1], 1)), 4 * [fine[-1]])
        pairs = zip(motions, sweep.best(rotated, fine[-1], _BEST_SECOND), strict=True)
        motions = third.align(_Motions(*map(np.concatenate, pairs)), 4 * [None])
    else:
        motions = _Motions(start[None, :3, :3], (start[None, :3, :3] @ center + start[None, :3, 3] - middle) / unit)
        motions = third.align(second.align(motions, middling), fine)
    equations = third.equations(motions)
    fit = equations.fit(max(_SCALE_PER_MEDIAN * float(np.median(equations.gaps, axis=1).min()), _MIN_SCALE))
    winner, *others = np.argsort(-fit, kind="stable").tolist()
    rivals = [motions.take([row]) for row in others if fit[row] > _MIN_FIT_RATIO * fit[winner]]
    ambiguity = max((_mesh_distance(motions.take([winner]), other, samples, by_faces) for other in rivals), default=0.0)
    motions = last.align(motions.take([winner]), _NUM_LAST_STEPS * [None])
    matrix = np.eye(4)
    matrix[:3, :3] = motions.rotations[0]
    matrix[:3, 3] = unit * motions.shifts[0] + middle - motions.rotations[0] @ center
    median_distance = unit * float(np.median(last.equations(motions).gaps))
    return Registration(matrix, median_distance, unit * ambiguity if ambiguity > _MIN_AMBIGUITY else 0.0)


def _nearest_sample(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Nearest:
    tree = cKDTree(points)

    def nearest(positions):
        _, rows = tree.query(positions)
        return points[rows], normals[rows]

    return nearest


def _nearest_point(vertices: Float[np.ndarray, "v 3"], mesh: trimesh.Trimesh) -> Nearest:
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(mesh.faces, np.int64)
    tree = optional("igl").AABB()
    tree.init(vertices, faces)

    def nearest(positions):
        _, rows, feet = tree.squared_distance(vertices, faces, np.ascontiguousarray(positions))
        return feet, mesh.face_normals[rows]

    return nearest


def _initial_motions(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], samples: Float[np.ndarray, "m 3"]
) -> _Motions:
    """Return the initial motions: rotations, each with a few shifts that put the scan in the mesh's box.

    The first shift centres the scan, and moves it along its mean normal to the front of the mesh. The other shifts are
    random.

    - `samples`: points of the mesh.
    """
    rotations = FreeRotation().rotations(_NUM_ROTATIONS)
    rotated = np.einsum("nj,sij->sni", points[:_THIRD], rotations)
    low, high = rotated.min(axis=1), rotated.max(axis=1)
    shift_low, shift_high = samples.min(axis=0) - low, samples.max(axis=0) - high
    mean_normals = rotations @ trimesh.unitize(normals.mean(axis=0) + 1e-12)
    front = (samples @ mean_normals.T).max(axis=0) - np.einsum("sni,si->sn", rotated, mean_normals).max(axis=1)
    central = 0.5 * (shift_low + shift_high)
    first = central + mean_normals * (front - np.sum(central * mean_normals, axis=1))[:, None]
    fractions = np.random.default_rng(0).random((_NUM_SHIFTS - 1, _NUM_ROTATIONS, 3))
    return _Motions(
        np.tile(rotations, (_NUM_SHIFTS, 1, 1)),
        np.concatenate([first, *(shift_low + fractions * (shift_high - shift_low))]),
    )


def _mesh_distance(first: _Motions, second: _Motions, samples: Float[np.ndarray, "m 3"], nearest: Nearest) -> float:
    """Return how far apart two motions place the mesh, as a mean distance.

    `first` and `second` each hold one motion from the scan to the mesh, so the inverse of a motion places the mesh at
    the scan. `samples` are points of the mesh. The result is the mean distance from the samples, placed by `second`, to
    the mesh, placed by `first`.
    """
    moved = (samples - second.shifts[0]) @ second.rotations[0] @ first.rotations[0].T + first.shifts[0]
    return float(np.mean(np.linalg.norm(moved - nearest(moved)[0], axis=1)))
