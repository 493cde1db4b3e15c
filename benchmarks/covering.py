"""Coverage as other papers count it, the points of a surface near a scanned point; and the candidates of Boundary
Exploration NBV (leihui6/BENBV), views beyond the boundary of the scanned surface."""

import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import jaxnbv as nbv

CANDIDATES = 800
# Settings of the published code: neighbours of a point, the empty angle that makes it a boundary point, clusters of
# boundary points, and the angles by which views turn about the boundary.
NEIGHBOURS, GAP, VIEWS, ROTATION_ANGLES = 30, np.radians(120.0), 20, np.radians([-45.0, 0.0, 45.0])


class Protocol(NamedTuple):
    """Settings of a paper's experiments. Lengths in metres.

    - `scale`: metres of one scene unit, for an object whose box has these sides.
    - `stride`: of the camera's image, for fewer rays of the same cone.
    - `step`: resolution of measured depths; 0 for exact ones.
    - `voxel`: size of the voxels of which one point each is kept; 0 to keep all points.
    """

    scale: Callable[[np.ndarray], float]
    camera: nbv.Camera
    stride: int
    distance: float
    tolerance: float
    step: float
    voxel: float
    points: int
    views: int
    repeats: int
    reported_views: tuple[int, ...]


class Look(NamedTuple):
    """One scan: the points of the surface that it covers, the normals there, and its own points."""

    covers: Bool[np.ndarray, " points"]
    normals: Float[np.ndarray, "points 3"]
    cloud: Float[np.ndarray, "hits 3"]


class Trial:
    """An object in a protocol: points of its surface, candidates around it, and the scans from poses."""

    def __init__(self, file: Path, protocol: Protocol, half: bool, up: str):
        self.mesh, self.protocol = nbv.load_mesh(file, up), protocol
        self.camera = protocol.camera.strided(protocol.stride)
        self.unit = protocol.scale(np.ptp(self.mesh.vertices, axis=0))
        key = jax.random.key(zlib.crc32(file.stem.encode()))
        directions = np.array(jax.random.normal(key, (CANDIDATES, 3)), np.float64)
        directions[:, 1] = np.abs(directions[:, 1]) if half else directions[:, 1]
        if protocol.repeats == 1:
            directions[0] = (1.0, 0.0, 0.0)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self.half, self.poses = half, nbv.look_at(protocol.distance / self.unit * directions)
        points = self.mesh.sample_points(key, protocol.points)
        self.points = one_a_voxel(points, points, protocol.voxel / self.unit)[0] if protocol.voxel else points
        self._covers: dict[int, np.ndarray] = {}
        directions = np.asarray(self.camera.pixel_directions(), np.float64)
        self._directions = directions.reshape(self.camera.height, self.camera.width, 3)

    def covers(self, candidates: Iterable[int]) -> Bool[np.ndarray, "candidates points"]:
        """Points of the surface that each of some candidates covers. Keeps the scans."""
        for index in candidates:
            if index not in self._covers:
                self._covers[index] = self.look(self.poses[index]).covers
        return np.stack([self._covers[index] for index in candidates])

    def look(self, pose: nbv.Pose) -> Look:
        """The scan from a pose, by the rays that can meet the object."""
        origin, rotation = np.asarray(pose.position, np.float64), np.asarray(pose.rotation, np.float64)
        local = (self.points - origin) @ rotation
        column, row = self.camera.to_pixels(local[:, :2] / local[:, 2:]).T
        rows, columns = (
            slice(max(int(coordinates.min()) - 1, 0), max(int(coordinates.max()) + 2, 0))
            for coordinates in (row, column)
        )
        local = self._directions[rows, columns].reshape(-1, 3)
        directions = local @ rotation.T
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        hits = self.mesh.trace(np.broadcast_to(origin, directions.shape), directions / length)
        is_hit = np.asarray(hits.mask)
        cloud, normals = np.asarray(hits.points, np.float64)[is_hit], np.asarray(hits.normals, np.float64)[is_hit]
        if len(cloud) == 0:
            return Look(np.zeros(len(self.points), bool), np.zeros_like(self.points), cloud)
        if step := self.protocol.step / self.unit:
            depth = (cloud - origin) @ rotation[:, 2:]
            cloud = origin + directions[is_hit] * step * np.round(depth / step)
        if self.protocol.voxel:
            cloud, normals = one_a_voxel(cloud, normals, self.protocol.voxel / self.unit)
        reach = self.protocol.tolerance / self.unit
        distances, nearest = cKDTree(cloud).query(self.points, distance_upper_bound=reach)
        is_covered = np.isfinite(distances)
        return Look(is_covered, np.where(is_covered[:, None], normals[np.where(is_covered, nearest, 0)], 0.0), cloud)


def one_a_voxel(points, normals, size: float) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """The mean point and normal of each voxel of a grid."""
    _, voxel, count = np.unique(np.floor(points / size), axis=0, return_inverse=True, return_counts=True)
    sums = [
        np.stack([np.bincount(voxel.ravel(), weights=axis) for axis in rows.T], axis=1) for rows in (points, normals)
    ]
    return sums[0] / count[:, None], sums[1] / np.maximum(np.linalg.norm(sums[1], axis=1, keepdims=True), 1e-12)


def boundary_views(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], seed: int
) -> tuple[Float[np.ndarray, "views 3"], Float[np.ndarray, "views 3"]]:
    """Boundary points to look at, one for each cluster, and unit directions to look from. Both are empty if there is no
    boundary."""
    tree = cKDTree(points)
    distances, neighbours = tree.query(points, k=min(NEIGHBOURS, len(points)))
    (rows,) = np.nonzero(is_boundary(points, normals, distances[:, 1:], neighbours[:, 1:]))
    if len(rows) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    _, label = kmeans2(points[rows], min(VIEWS, len(rows)), minit="++", seed=seed)
    indices = []
    for cluster in np.unique(label):
        members = rows[label == cluster]
        indices.append(members[np.argmin(np.linalg.norm(points[members] - points[members].mean(axis=0), axis=1))])
    targets, up = points[indices], normals[indices]
    out = unit(targets - points[neighbours[indices, 1:]].mean(axis=1))
    axes = np.cross(out, up)
    angles = ROTATION_ANGLES[np.arange(len(indices)) % len(ROTATION_ANGLES)][:, None] * np.linalg.norm(
        axes, axis=1, keepdims=True
    )
    directions = unit(axes)
    # The normals turned about the boundary.
    return targets, unit(Rotation.from_rotvec(angles * directions).apply(up))


def is_boundary(points, normals, distances, neighbours) -> Bool[np.ndarray, " n"]:
    """Whether the directions to a point's neighbours, seen along its normal, leave a gap of more than `GAP`."""
    first = unit(np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)]))
    second = np.cross(normals, first)
    offsets = points[neighbours] - points[:, None]
    angle = np.arctan2(np.einsum("nkd,nd->nk", offsets, second), np.einsum("nkd,nd->nk", offsets, first))
    is_near = distances < distances.mean()
    angle = np.sort(np.where(is_near, angle, np.inf), axis=1)
    count = np.sum(is_near, axis=1)
    with np.errstate(invalid="ignore"):
        gaps = np.nan_to_num(np.diff(angle, axis=1), nan=0.0, posinf=0.0)
    last = angle[np.arange(len(points)), np.maximum(count - 1, 0)]
    closing_gap = np.where(count > 0, 2.0 * np.pi - (last - angle[:, 0]), 2.0 * np.pi)
    return np.maximum(gaps.max(axis=1, initial=0.0), closing_gap) > GAP


def unit(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
