"""Recorded sequences of depth images with poses: 7-Scenes, TUM RGB-D, and a plain JSON file."""

import json
import math
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt16
from scipy.spatial.transform import Rotation

from jaxnbv.checks import AnyArray, InputError, as_numbers, require, shown
from jaxnbv.errors import optional
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose

# In seconds: an image and a pose of a TUM sequence that lie farther apart are not of one moment.
_APART = 0.02
# 7-Scenes marks what was not measured by the largest number there is.
_NOT_MEASURED = np.iinfo(np.uint16).max


class _Layout(NamedTuple):
    """What a data set says of a sequence: files, matrices from camera to world, intrinsics in pixels, and how long a
    unit of the depth images is."""

    files: list[Path]
    matrices: Float[np.ndarray, "n 4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    depth_scale: float


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
        folder = Path(folder)
        require(os.path.isdir(folder), f"there is no folder {folder}: give the place of the unpacked data set")
        layout = _layout(folder)
        absent = [file for file in layout.files if not os.path.isfile(file)]
        require(
            not absent,
            f"{len(absent)} of the {len(layout.files)} files that {folder} names are not there, the first "
            f"{absent[:1]}: unpack the data set again",
        )
        matrices = layout.matrices if up is None else _upward(up) @ layout.matrices
        try:
            Pose.from_matrix(matrices)
        except ValueError as error:
            raise InputError(f"a pose of {folder} is no pose ({error}): unpack the data set again") from error
        self.folder, self.files, self.matrices = folder, tuple(layout.files), matrices
        self.depth_scale = layout.depth_scale
        height, width = self.depth(0).shape
        self.camera = Camera.from_intrinsics(layout.intrinsics, height, width)

    def __len__(self) -> int:
        return len(self.files)

    def depth(self, index: int) -> UInt16[np.ndarray, "height width"]:
        """A depth image, in its own units; 0 where nothing was measured.

        **Raises:** `ValueError` for no frame, or an image that cannot be read or is no image of depths.
        """
        require(0 <= index < len(self), f"there is no frame {index}: {self.folder} has {len(self)}, counted from 0")
        file = self.files[index]
        images = optional("PIL.Image")
        try:
            pixels = np.asarray(images.open(file))
        except (OSError, images.DecompressionBombError) as error:
            raise InputError(f"cannot read the depth image {file} ({error}): unpack the data set again") from error
        whole = pixels.ndim == 2 and pixels.dtype.kind in "iu" and pixels.min() >= 0 and pixels.max() <= _NOT_MEASURED
        require(whole, f"{file} is an image of {pixels.dtype}, {pixels.shape}: depth images have one channel of 16 bit")
        return np.where(pixels == _NOT_MEASURED, 0, pixels).astype(np.uint16)


def _layout(folder: Path) -> _Layout:
    if os.path.isfile(folder / "frames.json"):
        return _plain(folder)
    if os.path.isfile(folder / "groundtruth.txt"):
        return _tum(folder)
    files = sorted(folder.glob("*.depth.png"))
    require(
        len(files) > 0,
        f"{folder} holds no recorded sequence: give a folder of 7-Scenes (frame-*.depth.png and .pose.txt), of TUM "
        "RGB-D (depth.txt and groundtruth.txt), or one with frames.json",
    )
    return _seven_scenes(folder, files)


def _seven_scenes(folder: Path, files: list[Path]) -> _Layout:
    poses = [file.with_name(file.name.replace(".depth.png", ".pose.txt")) for file in files]
    matrices = np.stack([_matrix(_rows(pose, "r1 r2 r3 t"), str(pose)) for pose in poses])
    own = folder / "camera-intrinsics.txt"
    # As published with the data set.
    usual = np.array([[585.0, 0.0, 320.0], [0.0, 585.0, 240.0], [0.0, 0.0, 1.0]])
    return _Layout(files, matrices, _rows(own, "a b c") if os.path.isfile(own) else usual, 1e-3)


def _tum(folder: Path) -> _Layout:
    images = folder / "depth.txt"
    listed = [line.split() for line in _lines(images, "lists nothing") if not line.startswith("#")]
    try:
        times = np.array([float(time) for time, _ in listed])
    except ValueError:
        times = np.zeros(0)
    proper = times.size > 0 and bool(np.isfinite(times).all())
    require(proper, f"{images} is damaged: each row must be a time and a file")
    track = _rows(folder / "groundtruth.txt", "time x y z qx qy qz qw")
    nearest = np.abs(times[:, None] - track[None, :, 0]).argmin(axis=1)
    kept = np.flatnonzero(np.abs(times - track[nearest, 0]) <= _APART)
    require(len(kept) > 0, f"no image of {folder} has a pose within {_APART} s: its lists are of two sequences")
    matrices = np.tile(np.eye(4), (len(kept), 1, 1))
    found = track[nearest[kept]]
    require(bool((np.linalg.norm(found[:, 4:], axis=1) > 0).all()), f"{folder} has a pose without rotation")
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(found[:, 4:]).as_matrix(), found[:, 1:4]
    # The data set's own for its first two sensors; a calibration of one's own goes to frames.json.
    usual = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
    return _Layout([folder / listed[index][1] for index in kept], matrices, usual, 1.0 / 5000.0)


def _plain(folder: Path) -> _Layout:
    path = folder / "frames.json"
    try:
        said: Any = json.loads(_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path} is no JSON ({error}): write it again") from error
    fields = {"intrinsics": list, "depth_scale": int | float, "frames": list}
    for name, kind in fields.items():
        given = said.get(name) if isinstance(said, dict) else None
        require(isinstance(given, kind) and not isinstance(given, bool), f"{path} has no {name}, but {shown(given)}")
    frames = said["frames"]
    named = all(isinstance(one, dict) and isinstance(one.get("depth"), str) and "pose" in one for one in frames)
    require(named and len(frames) > 0, f"the frames of {path} must each have a depth, a file, and a pose, 4 x 4")
    scale = float(said["depth_scale"])
    require(0 < scale < math.inf, f"the depth_scale of {path} is {scale}; it must be positive and finite")
    matrices = np.stack([_matrix(one["pose"], f"the pose of {one['depth']} in {path}") for one in frames])
    intrinsics = as_numbers(said["intrinsics"], f"the intrinsics in {path}", np.float64)
    return _Layout([folder / one["depth"] for one in frames], matrices, intrinsics, scale)


def _text(path: Path) -> str:
    require(os.path.isfile(path), f"there is no file {path}: the folder is incomplete, unpack the data set again")
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}): unpack the data set again") from error


def _lines(path: Path, nothing: str) -> list[str]:
    """Those of a text file that are not empty; `nothing` is said of a file without any."""
    lines = [line.strip() for line in _text(path).splitlines() if line.strip()]
    require(len(lines) > 0, f"{path} {nothing}: unpack the data set again")
    return lines


def _rows(path: Path, columns: str) -> Float[np.ndarray, "rows columns"]:
    """The finite numbers in a text file, of which each row has the columns."""
    lines = _lines(path, "is empty")
    try:
        rows = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error}): each row must be {columns}") from error
    count = len(columns.split())
    require(rows.shape[1] == count, f"{path} has {rows.shape[1]} columns; expected {count}: {columns}")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    require(bad.size == 0, f"{path} has numbers that are not finite, the first in row {bad[:1]}: unpack it again")
    return rows


def _matrix(values: AnyArray | list, name: str) -> Float[np.ndarray, "4 4"]:
    matrix = as_numbers(values, name, np.float64)
    require(matrix.shape == (4, 4), f"{name} has shape {matrix.shape}: a pose is 4 x 4, camera to world")
    return matrix


def _upward(up: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """The turn of the world that makes a direction z and keeps x in its plane."""
    found = as_numbers(up, "up", np.float64)
    length = float(np.linalg.norm(found)) if found.shape == (3,) else 0.0
    require(0 < length < math.inf, f"up is {shown(up)}; give a direction, such as (0, -1, 0)")
    z = found / length
    # Of a world whose x is upward, y takes its place.
    beside = np.eye(3)[int(abs(z[0]) > 0.9)]
    x = beside - (beside @ z) * z
    x /= np.linalg.norm(x)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([x, np.cross(z, x), z])
    return turn
