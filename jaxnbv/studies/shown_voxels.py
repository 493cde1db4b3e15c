"""The frames of a recording, and the voxels of a box that they show."""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxnbv.checks import require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.images import stride_of
from jaxnbv.progress import progress_bar
from jaxnbv.readers.recorded import RecordedFrames

# A voxel counts only if at least this number of frames show it. Others may be noise.
_MIN_FRAMES = 3
# For the default box: stride of the pixels that are used, and margin as a fraction of the box's longest side.
_BOUNDS_STRIDE, _MARGIN = 16, 0.05


class Recording(NamedTuple):
    """The frames of a recording, and the voxels of a box that at least three frames show.

    - `poses`: camera poses of the frames; `scans`: scans of the frames, cropped to the box; both in scene units.
    - `is_shown`: entry (i, j) is True if any pixel of frame i shows voxel j.
    - `voxels`: centres of the voxels; `camera_positions`: positions of the cameras; both in the recording's units.
    """

    poses: Pose
    scans: tuple[PointCloud, ...]
    is_shown: Bool[np.ndarray, "frames voxels"]
    voxels: Float[np.ndarray, "voxels 3"]
    camera_positions: Float[np.ndarray, "frames 3"]


def frame_of_box(box: Box) -> Frame:
    """Return the frame that maps a recording's coordinates to scene coordinates, and centres the box."""
    return Frame.fit(np.array([box.low, box.high]), up="z")


def bounds_of(frames: RecordedFrames) -> list[float]:
    """Return two corners of a box around nearly all points of a recording, as six numbers in its units.

    Along each axis, the box spans the 1st to the 99th percentile of the points' coordinates. A margin of 5 % of the
    longest side is added on all sides.

    **Raises:** `ValueError` if no frame has a valid depth.
    """
    points = np.concatenate([_points(frames, index, _BOUNDS_STRIDE) for index in range(len(frames))])
    require(len(points) > 0, f"no frame of {frames.folder} has a valid depth")
    low, high = np.percentile(points, [1, 99], axis=0)
    margin = _MARGIN * float((high - low).max())
    return [*(low - margin).tolist(), *(high + margin).tolist()]


@functools.cache
def read_recording(source: tuple[Any, ...], box: Box, voxel: float, scan_box: Box) -> Recording:
    """Read a recording. The result is cached, so that a process reads each recording only once.

    - `source`: the arguments of `RecordedFrames`.
    - `box`: the box whose voxels are counted; `scan_box`: the box to which scans are cropped; `voxel`: side of a voxel;
      all in the recording's units.

    **Raises:** `ValueError` if no voxel of the box shows in three frames, and whenever `RecordedFrames` raises it.
    """
    frames, frame = RecordedFrames(*source), frame_of_box(box)
    poses, stride = Pose.from_matrix(frames.matrices), stride_of(frames.camera)
    count = frames.camera.strided(stride).num_rays
    zeros, is_point = jnp.zeros((count, 3)), jnp.zeros(count, bool)
    scans, cells_of_frames = [], []
    for index in progress_bar(range(len(frames)), desc="reading frames"):
        # Scans use every `stride`-th pixel. Use all pixels here, because fewer would miss voxels that the frame shows.
        points = _points(frames, index, 1)
        points = points[np.all((points >= box.low) & (points <= box.high), axis=1)]
        # A frame without points in the box gives an empty scan, by which nothing is carved.
        scan = PointCloud(zeros, zeros, is_point, is_point, jnp.zeros(count))
        if len(points) > 0:
            image = frames.depth(index), frames.camera, poses[index], frames.depth_scale, stride
            scan = PointCloud.from_depth(*image, scan_box)
        scans.append(frame.to_scene(scan))
        cells_of_frames.append(np.unique(np.floor(points / voxel).astype(int), axis=0))
    frame_of_row = np.repeat(np.arange(len(frames)), [len(rows) for rows in cells_of_frames])
    all_cells = np.concatenate(cells_of_frames)
    cells, cell_of_row, counts = np.unique(all_cells, axis=0, return_inverse=True, return_counts=True)
    is_shown = np.zeros((len(frames), len(counts)), bool)
    is_shown[frame_of_row, cell_of_row] = True
    is_counted = counts >= _MIN_FRAMES
    problem = f"no voxel of {box} shows in {_MIN_FRAMES} frames of {frames.folder}"
    require(bool(is_counted.any()), f"{problem}: give another box")
    voxels, positions = voxel * (cells[is_counted] + 0.5), frames.matrices[:, :3, 3]
    return Recording(frame.to_scene(poses), tuple(scans), is_shown[:, is_counted], voxels, positions)


def _points(frames: RecordedFrames, index: int, stride: int) -> Float[np.ndarray, "n 3"]:
    """Return a frame's points in the recording's coordinates, from every `stride`-th row and column."""
    camera, matrix = frames.camera.strided(stride), frames.matrices[index]
    rows = slice(stride // 2, None, stride)
    depth = frames.depth_scale * frames.depth(index)[rows, rows].reshape(-1)
    local = np.asarray(camera.pixel_directions(), np.float64)[depth > 0] * depth[depth > 0, None]
    return local @ matrix[:3, :3].T + matrix[:3, 3]
