"""A small recording, in three layouts of data sets."""

import json

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import jaxnbv as nbv

UNIT = 1000.0
INTRINSICS = np.array([[40.0, 0.0, 23.5], [0.0, 40.0, 17.5], [0.0, 0.0, 1.0]])
CAMERA = nbv.Camera.from_intrinsics(INTRINSICS, height=36, width=48)
COUNT = 9


def recorded():
    """A ball of 0.3 m at (1, 2, 0.5), seen from a half circle around it: depths in mm, and matrices in metres."""
    center, depths, matrices = np.array([1.0, 2.0, 0.5]), [], []
    for angle in np.linspace(0.0, np.pi, COUNT):
        eye = center + 1.2 * np.array([np.cos(angle), np.sin(angle), 0.3])
        pose = nbv.look_at(eye, center, up=(0.0, 0.0, 1.0))
        ball = nbv.SDFSurface(nbv.sdf.Sphere(0.3).translate(center.tolist()))
        scan = nbv.scan(ball, CAMERA, pose)
        depth = (np.asarray(scan.points, np.float64) - eye) @ np.asarray(pose.forward, np.float64)
        depths.append(np.where(scan.mask, np.round(UNIT * depth), 0).astype(np.uint16).reshape(36, 48))
        matrices.append(np.asarray(pose.to_matrix(), np.float64))
    return np.stack(depths), np.stack(matrices)


def save(path, depth):
    Image.fromarray(depth).save(path)


def seven_scenes(folder, depths, matrices):
    for index, (depth, matrix) in enumerate(zip(depths, matrices, strict=True)):
        hole = depth.copy()
        # The data set's own mark of a missing depth.
        hole[depth == 0] = 65535
        save(folder / f"frame-{index:06d}.depth.png", hole)
        np.savetxt(folder / f"frame-{index:06d}.pose.txt", matrix, delimiter="\t")


def tum(folder, depths, matrices):
    (folder / "depth").mkdir()
    images, track = ["# time file"], ["# time tx ty tz qx qy qz qw"]
    for index, (depth, matrix) in enumerate(zip(depths, matrices, strict=True)):
        time = 1305031102.16 + 0.03 * index
        save(folder / "depth" / f"{index}.png", 5 * depth)
        images.append(f"{time:.6f} depth/{index}.png")
        quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        track.append(" ".join(f"{x:.9f}" for x in [time + 0.004, *matrix[:3, 3], *quaternion]))
    # This image has no pose.
    images.append("1305031109.000000 depth/0.png")
    (folder / "depth.txt").write_text("\n".join(images))
    (folder / "groundtruth.txt").write_text("\n".join(track))


def plain(folder, depths, matrices):
    frames = []
    for index, (depth, matrix) in enumerate(zip(depths, matrices, strict=True)):
        save(folder / f"{index}.png", depth)
        frames.append({"depth": f"{index}.png", "pose": matrix.tolist()})
    (folder / "frames.json").write_text(json.dumps({"frames": frames}))


LAYOUTS = (seven_scenes, tum, plain)


def known_sensor(layout, folder, sequence):
    """A folder that states its intrinsics."""
    layout(folder, *sequence)
    np.savetxt(folder / "camera-intrinsics.txt", INTRINSICS)


def points_of(z, intrinsics, matrix):
    """World coordinates of the pixels of a depth image in metres, by an independent pinhole."""
    row, column = np.nonzero(z)
    (fx, _, cx), (_, fy, cy), _ = intrinsics
    local = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(len(row))], axis=-1) * z[row, column, None]
    return local @ matrix[:3, :3].T + matrix[:3, 3]
