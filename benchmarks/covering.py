"""What scans of an object cover, as peers count it: points of its surface that a scanned point is near to."""

import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

import jaxnbv as nbv

CANDIDATES = 800


class Protocol(NamedTuple):
    """Lengths in metres; `scale`: metres for one scene unit, of an object whose box has these sides.

    - `stride`: of the camera's image, for fewer rays of the same cone.
    - `step`: to what the sensor measures; 0 for exactly. `voxel`: of which one point is kept; 0 for all.
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
    reported: tuple[int, ...]


class Look(NamedTuple):
    """What one scan shows: whether it covers each point of the surface; the normals there; and its own points."""

    covers: Bool[np.ndarray, " points"]
    normals: Float[np.ndarray, "points 3"]
    cloud: Float[np.ndarray, "hits 3"]


class Trial:
    """An object in a protocol: points of its surface, candidates about it, and what each pose shows of it."""

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
        self._known: dict[int, np.ndarray] = {}
        directions = np.asarray(self.camera.pixel_directions(), np.float64)
        self._directions = directions.reshape(self.camera.height, self.camera.width, 3)

    def covers(self, candidates: Iterable[int]) -> Bool[np.ndarray, "candidates points"]:
        """What each of some candidates covers; none is scanned twice."""
        for index in candidates:
            if index not in self._known:
                self._known[index] = self.look(self.poses[index]).covers
        return np.stack([self._known[index] for index in candidates])

    def look(self, pose: nbv.Pose) -> Look:
        """What the sensor sees from a pose, by those of its rays that can meet the object."""
        origin, rotation = np.asarray(pose.position, np.float64), np.asarray(pose.rotation, np.float64)
        local = (self.points - origin) @ rotation
        column, row = self.camera.to_pixels(local[:, :2] / local[:, 2:]).T
        rows, columns = (slice(max(int(at.min()) - 1, 0), max(int(at.max()) + 2, 0)) for at in (row, column))
        local = self._directions[rows, columns].reshape(-1, 3)
        directions = local @ rotation.T
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        hits = self.mesh.trace(np.broadcast_to(origin, directions.shape), directions / length)
        hit = np.asarray(hits.mask)
        cloud, normals = np.asarray(hits.points, np.float64)[hit], np.asarray(hits.normals, np.float64)[hit]
        if len(cloud) == 0:
            return Look(np.zeros(len(self.points), bool), np.zeros_like(self.points), cloud)
        if step := self.protocol.step / self.unit:
            depth = (cloud - origin) @ rotation[:, 2:]
            cloud = origin + directions[hit] * step * np.round(depth / step)
        if self.protocol.voxel:
            cloud, normals = one_a_voxel(cloud, normals, self.protocol.voxel / self.unit)
        reach = self.protocol.tolerance / self.unit
        apart, nearest = cKDTree(cloud).query(self.points, distance_upper_bound=reach)
        covers = np.isfinite(apart)
        return Look(covers, np.where(covers[:, None], normals[np.where(covers, nearest, 0)], 0.0), cloud)


def one_a_voxel(points, normals, size: float) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """The mean point and normal of each voxel of a grid."""
    _, voxel, count = np.unique(np.floor(points / size), axis=0, return_inverse=True, return_counts=True)
    sums = [
        np.stack([np.bincount(voxel.ravel(), weights=axis) for axis in rows.T], axis=1) for rows in (points, normals)
    ]
    return sums[0] / count[:, None], sums[1] / np.maximum(np.linalg.norm(sums[1], axis=1, keepdims=True), 1e-12)
