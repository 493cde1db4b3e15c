"""Clutter around the box of a session, as coarse cells that contain measured points."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.distortion import pixels_of
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.images import Image
from jaxnbv.scanning import Obstacles
from jaxnbv.scanning.sdf import Sampled

# Number of cells along a side of the cube of cells. A cell is then about 1.5 cm wide for an object of 20 cm.
_NUM_CELLS = 48
# An image shows a cell as occupied if at least this many of the image's points lie in the cell. Fewer points may be
# flying pixels at a depth edge.
_MIN_POINTS = 5
# Largest normalised image coordinate (x / z or y / z) for which the distortion formula is used.
_MAX_COORDINATE = 3.0


class Clutter(NamedTuple):
    """Occupancy votes for the cells of a cube about the middle of the scene, in scene coordinates.

    - `votes`: for each cell, the number of images that show it as occupied minus the number that see through it.
    - `half_extent`: half the side of the cube.
    - `box`: box of the object. Cells in or near the box get no votes.
    """

    votes: Int[np.ndarray, "n n n"]
    half_extent: float
    box: Box

    @classmethod
    def empty(cls, half_extent: float, box: Box) -> "Clutter":
        """Return clutter without votes."""
        return cls(np.zeros((_NUM_CELLS,) * 3, np.int64), half_extent, box)

    def with_image(self, image: Image, camera: Camera, pose: Pose, frame: Frame, obstacles: Obstacles) -> "Clutter":
        """Return a copy with the votes of one more image. Cells in or next to an obstacle get no votes.

        The camera and its pose are in world units, the obstacles in scene units.
        """
        depth = image.world_depth if image.robot is None else np.where(image.robot, 0.0, image.world_depth)
        points = np.asarray(frame.to_scene(image.points(camera, pose)[depth > 0]), np.float64)
        cells = np.floor((points + self.half_extent) / self.spacing).astype(int)
        cells = cells[((cells >= 0) & (cells < _NUM_CELLS)).all(axis=1)]
        numbers = np.ravel_multi_index(tuple(cells.T), self.votes.shape)
        is_occupied = np.bincount(numbers, minlength=self.votes.size).reshape(self.votes.shape) >= _MIN_POINTS
        centers = self._centers()
        is_near_box = np.asarray(self.box(centers)) < self.spacing
        is_of_obstacle = np.asarray(obstacles.distance(centers)) < obstacles.margin + self.spacing
        is_empty = self._is_seen_through(depth, camera, pose, frame) & ~is_occupied
        votes = self.votes + is_occupied.astype(int) - is_empty.astype(int)
        return self._replace(votes=np.where(is_near_box | is_of_obstacle, 0, votes))

    def solid(self) -> Sampled | None:
        """Return the occupied cells as a solid in scene units; None if no cell is occupied."""
        is_occupied = self.votes > 0
        if not is_occupied.any():
            return None
        # The transforms give distances between the centres of cells. A face is half a cell nearer than a centre.
        inside, outside = distance_transform_edt(is_occupied), distance_transform_edt(~is_occupied)
        cells = np.where(is_occupied, 0.5 - inside, outside - 0.5)
        return Sampled((self.spacing * cells).astype(np.float32), self._centers()[0, 0, 0], self.spacing, 0.0)

    @property
    def spacing(self) -> float:
        """Side length of a cell, in scene units."""
        return 2.0 * self.half_extent / _NUM_CELLS

    def _centers(self) -> Float[np.ndarray, "n n n 3"]:
        axis = (np.arange(_NUM_CELLS) + 0.5) * self.spacing - self.half_extent
        return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)

    def _is_seen_through(
        self, depth: Float[np.ndarray, "height width"], camera: Camera, pose: Pose, frame: Frame
    ) -> Bool[np.ndarray, "n n n"]:
        """Return a mask of the cells that are nearer than the depth measured at their pixel, by over a cell."""
        cell = frame.length_to_world(self.spacing)
        centers = np.asarray(frame.to_world(self._centers().reshape(-1, 3)), np.float64)
        local = (centers - np.asarray(pose.position, np.float64)) @ np.asarray(pose.rotation, np.float64)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            coordinates = local[:, :2] / local[:, 2:]
            # The distortion formula is not valid far outside the image.
            coordinates = np.where(
                (np.abs(coordinates) < _MAX_COORDINATE).all(axis=1, keepdims=True), coordinates, np.nan
            )
            pixels = pixels_of(coordinates, camera.intrinsics, camera.distortion)
        column, row = (np.nan_to_num(pixel, nan=-1.0) for pixel in pixels)
        column, row = np.round(column).astype(int), np.round(row).astype(int)
        is_in_image = (local[:, 2] > 0) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
        measured_depths = np.zeros(len(centers))
        measured_depths[is_in_image] = depth[row[is_in_image], column[is_in_image]]
        return (measured_depths > local[:, 2] + cell).reshape(self.votes.shape)
