"""Recorded sequences of depth images with poses: 7-Scenes, TUM RGB-D, and a plain JSON file."""

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import Rotation

from jaxnbv.checks import InputError, as_numbers, require, shown
from jaxnbv.errors import optional
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose

# In seconds: an image and a pose of a TUM sequence that lie farther apart are not of one moment.
_APART = 0.02
# 7-Scenes marks what was not measured by the largest number there is.
_NOT_MEASURED = np.iinfo(np.uint16).max
# Published with the data sets, of TUM RGB-D for its first two sensors.
_INTRINSICS_7_SCENES = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])
_INTRINSICS_TUM = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])


# Files, matrices from camera to world, intrinsics in pixels, and how long a unit of the depth images is.
_Layout: TypeAlias = tuple[list[Path], Float[np.ndarray, "n 4 4"], Float[np.ndarray, "3 3"], float]


class RecordedFrames:
    """The frames of a recorded sequence: depth images, each read when it is asked for, and where they were taken.

    - `folder`: as one of these data sets is unpacked,
        - 7-Scenes: `frame-000000.depth.png` (16 bit, mm) and `frame-000000.pose.txt` (4 x 4, camera to world, metres);
          `camera-intrinsics.txt` (3 x 3) where it is not the data set's own;
        - TUM RGB-D: `depth.txt` (time, file) and `groundtruth.txt` (time, position, quaternion); images of 5,000 a
          metre. An image without a pose within 20 ms is left out;
        - `frames.json`: `{"intrinsics": 3 x 3, "depth_scale": 0.001, "frames": [{"depth": FILE, "pose": 4 x 4}, ...]}`,
          files relative to it, camera to world in OpenCV's axes.
    - `up`: where given, the direction that is upward in the world, which is then turned so that this becomes z, and x
      stays in its plane.

    `camera` is the sensor and `matrices` (n, 4, 4) its poses, OpenCV axes, in world units; `depth_scale` times an image
    is in these. Add frame i to a session by `session.add(frames.depth(i), frames.matrices[i], frames.depth_scale)`.

    **Raises:** `ValueError` if the folder holds none of these, or what is missing or damaged in it.
    """

    def __init__(self, folder: str | Path, up: tuple[float, float, float] | None = None):
        folder, turn = Path(folder), np.eye(4) if up is None else _upward(up)
        require(os.path.isdir(folder), f"there is no folder {folder}: give the place of the unpacked data set")
        read = next((reader for sign, reader in _READERS.items() if any(folder.glob(sign))), None)
        if read is None:
            raise InputError(
                f"{folder} holds no recorded sequence: give a folder of 7-Scenes (frame-*.depth.png and .pose.txt), of "
                "TUM RGB-D (depth.txt and groundtruth.txt), or one with frames.json"
            )
        try:
            files, matrices, intrinsics, depth_scale = read(folder)
            matrices = turn @ matrices
            Pose.from_matrix(matrices)
        except (OSError, ValueError, LookupError, TypeError) as error:
            problem = f"the recording in {folder} is not whole ({type(error).__name__}: {error})"
            raise InputError(f"{problem}: unpack the data set again") from error
        absent = [file for file in files if not os.path.isfile(file)]
        require(
            not absent,
            f"{len(absent)} of the {len(files)} files that {folder} names are not there, the first "
            f"{absent[:1]}: unpack the data set again",
        )
        self.folder, self.files, self.matrices, self.depth_scale = folder, tuple(files), matrices, depth_scale
        height, width = self.depth(0).shape
        self.camera = Camera.from_intrinsics(intrinsics, height, width)

    def __len__(self) -> int:
        return len(self.files)

    def depth(self, index: int) -> UInt16[np.ndarray, "height width"]:
        """A depth image, in its own units; 0 where nothing was measured.

        **Raises:** `ValueError` for no frame, or an image that cannot be read or is no image of depths.
        """
        require(0 <= index < len(self), f"there is no frame {index}: {self.folder} has {len(self)}, counted from 0")
        file = self.files[index]
        try:
            pixels = np.asarray(optional("PIL.Image").open(file))
        except OSError as error:
            raise InputError(f"cannot read the depth image {file} ({error}): unpack the data set again") from error
        whole = pixels.ndim == 2 and pixels.dtype.kind in "iu" and pixels.min() >= 0 and pixels.max() <= _NOT_MEASURED
        require(whole, f"{file} is an image of {pixels.dtype}, {pixels.shape}: depth images have one channel of 16 bit")
        return np.where(pixels == _NOT_MEASURED, 0, pixels).astype(np.uint16)


def _seven_scenes(folder: Path) -> _Layout:
    files = sorted(folder.glob("*.depth.png"))
    poses = [_table(file.with_name(file.name.replace(".depth.png", ".pose.txt"))) for file in files]
    own = folder / "camera-intrinsics.txt"
    intrinsics = _table(own) if os.path.isfile(own) else _INTRINSICS_7_SCENES
    return files, np.stack(poses), intrinsics, 1e-3


def _tum(folder: Path) -> _Layout:
    lines = (folder / "depth.txt").read_text().splitlines()
    images = np.array([line.split() for line in lines if line and not line.startswith("#")])
    times, track = images[:, 0].astype(float), _table(folder / "groundtruth.txt")
    nearest = np.abs(times[:, None] - track[None, :, 0]).argmin(axis=1)
    kept = np.flatnonzero(np.abs(times - track[nearest, 0]) <= _APART)
    require(len(kept) > 0, f"no image has a pose within {_APART} s")
    found = track[nearest[kept]]
    matrices = np.tile(np.eye(4), (len(kept), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(found[:, 4:]).as_matrix(), found[:, 1:4]
    return [folder / images[index, 1] for index in kept], matrices, _INTRINSICS_TUM, 1.0 / 5000.0


def _plain(folder: Path) -> _Layout:
    said = json.loads((folder / "frames.json").read_text())
    files = [folder / frame["depth"] for frame in said["frames"]]
    matrices = np.stack([np.array(frame["pose"], float) for frame in said["frames"]])
    scale = float(said["depth_scale"])
    require(0 < scale < math.inf, f"the depth_scale is {scale}; it must be positive and finite")
    return files, matrices, np.array(said["intrinsics"], float), scale


# By a file that tells it.
_READERS: dict[str, Callable[[Path], _Layout]] = {
    "frames.json": _plain,
    "groundtruth.txt": _tum,
    "*.depth.png": _seven_scenes,
}


def _table(path: Path) -> Float[np.ndarray, "rows columns"]:
    """The numbers in a text file."""
    try:
        return np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path} is no table: {error}") from error


def _upward(up: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """The turn of the world that makes a direction z and keeps x in its plane."""
    found = as_numbers(up, "up", np.float64)
    length = float(np.linalg.norm(found)) if found.shape == (3,) else 0.0
    require(0 < length < math.inf, f"up is {shown(up)}; give a direction, such as (0, -1, 0)")
    # Of a world whose x is upward, y takes its place.
    beside = np.eye(3)[int(abs(found[0]) > 0.9 * length)]
    rotation, _ = Rotation.align_vectors(np.eye(3)[[2, 0]], [found / length, beside], weights=[np.inf, 1.0])
    turn = np.eye(4)
    turn[:3, :3] = rotation.as_matrix()
    return turn
