"""Recorded sequences of depth images with poses: 7-Scenes, TUM RGB-D, and a plain JSON file."""

import functools
import json
import math
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt16
from scipy.spatial.transform import Rotation

from jaxnbv.checks import AnyArray, InputError, as_numbers, require, short_text
from jaxnbv.errors import optional
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import rigid_matrices
from jaxnbv.readers.depth_unit import depth_unit
from jaxnbv.readers.intrinsics import intrinsic_matrix, stored_intrinsics
from jaxnbv.readers.own_parts import own_parts
from jaxnbv.readers.text_files import read_rows, read_table, read_text

# Largest difference in seconds between the times of an image and of its pose in a TUM sequence.
_MAX_TIME_DIFFERENCE = 0.02
# 7-Scenes stores this number where nothing was measured.
_NO_MEASUREMENT = np.iinfo(np.uint16).max
_ASK_INTRINSICS = (
    "give intrinsics=(fx, fy, cx, cy) in pixels (on the command line --intrinsics FX FY CX CY), or put a "
    "camera-intrinsics.txt into it. As published: 585, 585, 320, 240 for 7-Scenes; 517.3, 516.5, 318.6, 255.3 for "
    "freiburg1 of TUM RGB-D, 520.9, 521.0, 325.1, 249.7 for freiburg2, 535.4, 539.2, 320.1, 247.6 for freiburg3; "
    "481.2, 480, 319.5, 239.5 for ICL-NUIM"
)
_ASK_UNIT = (
    "give depth_scale= (on the command line --depth-scale): 1/1000 for millimetres (7-Scenes, 3DMatch), 1/5000 for TUM "
    "RGB-D and ICL-NUIM, 1/10000 for tenths of a millimetre"
)


class _StoredRecording(NamedTuple):
    """Depth image files, camera-to-world matrices, and, if the recording has them, intrinsics and unit."""

    files: list[Path]
    matrices: Float[np.ndarray, "n 4 4"]
    intrinsics: Float[np.ndarray, "3 3"] | None = None
    depth_scale: float | None = None


class RecordedFrames:
    """The frames of a recorded sequence: depth images, which are read on request, and their poses.

    - `folder`: the unpacked folder, in one of these formats:
        - 7-Scenes: `frame-000000.depth.png` (16 bit) and `frame-000000.pose.txt` (4 x 4, camera to world);
        - TUM RGB-D: `depth.txt` (time, file) and `groundtruth.txt` (time, position, quaternion). An image is left out
          if no pose was recorded within 20 ms of it;
        - `frames.json`: `{"intrinsics": 3 x 3, "depth_scale": 0.001, "frames": [{"depth": FILE, "pose": 4 x 4}, ...]}`,
          with file names relative to the folder, and poses from camera to world in OpenCV's axes. `intrinsics` and
          `depth_scale` may be left out.
    - `up`: upward direction in the world. If given, the world is rotated so that this direction becomes z, and the
      former x axis lies in the plane y = 0.
    - `intrinsics`: intrinsics of the depth camera in pixels: a 3 x 3 matrix, or fx, fy, cx, cy. By default they are
      read from `frames.json`, or from a file in the folder or its parent: `camera-intrinsics.txt` (3 x 3) or a similar
      file of 3DMatch, ScanNet, ETH3D, BundleFusion or Open3D. The formats 7-Scenes and TUM RGB-D do not store
      intrinsics.
    - `depth_scale`: length of the images' unit in the unit of the poses, for example 1/5000. By default it is read from
      `frames.json`, or is the usual unit (1/1000, 1/5000, 1/10000, ...) for which frames that show the same surface
      agree.

    `camera` is the sensor, and `matrices` (n, 4, 4) are its poses in world units, with OpenCV's axes. To add frame i to
    a session, call `session.add(frames.depth(i), frames.matrices[i], frames.depth_scale)`. Frames without a valid pose
    (not finite, zeros, or no rotation) are left out with a `UserWarning`. Pixels that show the camera's own mount, such
    as a gripper, are set to 0 with a `UserWarning`.

    **Raises:** `ValueError` if the folder has none of these formats, or is incomplete or damaged, if there are no
    intrinsics, if the frames do not determine the unit, or if most poses are invalid.
    """

    def __init__(
        self,
        folder: str | Path,
        up: tuple[float, float, float] | None = None,
        intrinsics: Float[AnyArray, "..."] | list | tuple | None = None,
        depth_scale: float | None = None,
    ):
        folder, rotation = Path(folder), np.eye(4) if up is None else _rotation_to_z_up(up)
        require(os.path.isdir(folder), f"there is no folder {folder}: give the place of the unpacked data set")
        reader = next((reader for pattern, reader in _READERS.items() if any(folder.glob(pattern))), None)
        if reader is None:
            raise InputError(
                f"{folder} holds no recorded sequence: give a folder of 7-Scenes (frame-*.depth.png and .pose.txt), of "
                "TUM RGB-D (depth.txt and groundtruth.txt), or one with frames.json"
            )
        try:
            recording = reader(folder)
            rigid, is_rigid = rigid_matrices(recording.matrices)
        except (OSError, ValueError, LookupError, TypeError) as error:
            problem = f"the recording in {folder} is not whole ({type(error).__name__}: {error})"
            raise InputError(f"{problem}: unpack the data set again") from error
        files = _with_pose(recording.files, is_rigid, folder)
        absent = [file for file in files if not os.path.isfile(file)]
        require(
            not absent,
            f"{len(absent)} of the {len(files)} files that {folder} names are not there, the first "
            f"{absent[:1]}: unpack the data set again",
        )
        self.folder, self.files, self.matrices = folder, tuple(files), rotation @ rigid[is_rigid]
        matrix = recording.intrinsics if intrinsics is None else intrinsic_matrix(intrinsics, "the intrinsics")
        matrix = stored_intrinsics(folder) if matrix is None else matrix
        if matrix is None:
            raise InputError(f"nothing in {folder} says the intrinsics of its depth camera: {_ASK_INTRINSICS}")
        self.camera = Camera.from_intrinsics(matrix, *self._stored(0).shape)
        scale = recording.depth_scale if depth_scale is None else depth_scale
        scale = depth_unit(self._stored, self.matrices, self.camera) if scale is None else scale
        if scale is None:
            raise InputError(f"the frames of {folder} do not determine the unit of their depths: {_ASK_UNIT}")
        require(0 < scale < 100, f"the depth scale is {short_text(scale)}, which is no length of a unit: {_ASK_UNIT}")
        self.depth_scale = float(scale)

    def __len__(self) -> int:
        return len(self.files)

    def depth(self, index: int) -> UInt16[np.ndarray, "height width"]:
        """Return the depth image of a frame in units of `depth_scale`.

        It is 0 where nothing was measured, and where it shows the camera's mount.

        **Raises:** `ValueError` for an index out of range, or an image that cannot be read or is not a depth image.
        """
        pixels = self._stored(index)
        # An image that is not as large as the first is returned unchanged, because the session raises an error for it.
        is_own = pixels <= self._own_parts if pixels.shape == self._own_parts.shape else False
        return np.where(is_own, 0, pixels).astype(np.uint16)

    @functools.cached_property
    def _own_parts(self) -> Float[np.ndarray, "height width"]:
        parts = own_parts(self._stored, self.matrices, self.camera, self.depth_scale)
        if parts.any():
            warnings.warn(
                f"{np.mean(parts > 0):.0%} of the image show the same in the frames of {self.folder} wherever the "
                f"camera is, up to {self.depth_scale * parts.max():.3g} from it: these are parts of the camera's mount "
                "and are left out",
                stacklevel=4,
            )
        return parts

    def _stored(self, index: int) -> UInt16[np.ndarray, "height width"]:
        """Read the depth image of a frame, with the mount. It is 0 where nothing was measured."""
        require(0 <= index < len(self), f"there is no frame {index}: {self.folder} has {len(self)}, counted from 0")
        file = self.files[index]
        try:
            pixels = np.asarray(optional("PIL.Image").open(file))
        except OSError as error:
            raise InputError(f"cannot read the depth image {file} ({error}): unpack the data set again") from error
        kind, is_depth = f"{pixels.dtype}, {pixels.shape}", pixels.ndim == 2 and pixels.dtype.kind in "iu"
        is_valid = is_depth and 0 <= pixels.min() <= pixels.max() <= _NO_MEASUREMENT
        require(is_valid, f"{file} is an image of {kind}: depth images have one channel of 16 bit")
        return np.where(pixels == _NO_MEASUREMENT, 0, pixels).astype(np.uint16)


def _seven_scenes(folder: Path) -> _StoredRecording:
    files = sorted(folder.glob("*.depth.png"))
    poses = [read_table(file.with_name(file.name.replace(".depth.png", ".pose.txt"))) for file in files]
    return _StoredRecording(files, np.stack(poses))


def _tum(folder: Path) -> _StoredRecording:
    images = np.array([row[:2] for row in read_rows(folder / "depth.txt")])
    times, track = images[:, 0].astype(float), read_table(folder / "groundtruth.txt")
    nearest = np.abs(times[:, None] - track[None, :, 0]).argmin(axis=1)
    rows = np.flatnonzero(np.abs(times - track[nearest, 0]) <= _MAX_TIME_DIFFERENCE)
    require(len(rows) > 0, f"no image has a pose within {_MAX_TIME_DIFFERENCE} s")
    poses = track[nearest[rows], 1:8]
    length = np.linalg.norm(poses[:, 3:], axis=1)
    is_rotation = np.isfinite(length) & (length > 0)
    matrices = np.full((len(rows), 4, 4), np.nan)
    matrices[:, :3, 3], matrices[:, 3] = poses[:, :3], (0.0, 0.0, 0.0, 1.0)
    matrices[is_rotation, :3, :3] = Rotation.from_quat(poses[is_rotation, 3:]).as_matrix()
    return _StoredRecording([folder / images[index, 1] for index in rows], matrices)


def _plain(folder: Path) -> _StoredRecording:
    content = json.loads(read_text(folder / "frames.json"))
    files = [folder / frame["depth"] for frame in content["frames"]]
    matrices = np.stack([np.array(frame["pose"], float) for frame in content["frames"]])
    intrinsics, scale = content.get("intrinsics"), content.get("depth_scale")
    return _StoredRecording(
        files,
        matrices,
        None if intrinsics is None else intrinsic_matrix(intrinsics, "intrinsics"),
        None if scale is None else float(scale),
    )


# The reader of each format, keyed by a pattern of the format's files.
_READERS: dict[str, Callable[[Path], _StoredRecording]] = {
    "frames.json": _plain,
    "groundtruth.txt": _tum,
    "*.depth.png": _seven_scenes,
}


def _with_pose(files: list[Path], has_pose: Bool[np.ndarray, " n"], folder: Path) -> list[Path]:
    """Return the files with a valid pose. Warns if some have none, and raises `ValueError` if most have none."""
    names = [file.name for file, is_posed in zip(files, has_pose, strict=True) if not is_posed]
    problem = f"{len(names)} of the {len(files)} poses in {folder} are no rigid motion, the first that of {names[:1]}"
    require(
        2 * len(names) <= len(files),
        f"{problem}: give 4 x 4 matrices from camera to world, [[R, t], [0, 1]] with R R^T = I",
    )
    if names:
        warnings.warn(f"{problem}: these frames are left out", stacklevel=3)
    return [file for file, is_posed in zip(files, has_pose, strict=True) if is_posed]


def _rotation_to_z_up(up: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """Return the 4 x 4 matrix of the rotation that maps `up` to z and the x axis into the plane y = 0."""
    direction = as_numbers(up, "up", np.float64)
    length = float(np.linalg.norm(direction)) if direction.shape == (3,) else 0.0
    require(0 < length < math.inf, f"up is {short_text(up)}; give a direction, such as (0, -1, 0)")
    # If `up` is nearly parallel to x, map the y axis into the plane y = 0 instead.
    second_axis = np.eye(3)[int(abs(direction[0]) > 0.9 * length)]
    rotation, _ = Rotation.align_vectors(np.eye(3)[[2, 0]], [direction / length, second_axis], weights=[np.inf, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    return matrix
