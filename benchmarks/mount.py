"""Cost of an error in the camera's mount, and the share of it that alignment of the views removes.

    python benchmarks/mount.py --parts FOLDER [--objects 10] [--degrees 1] [--length 0.005]
    python benchmarks/mount.py --recording FOLDER [--every 3] [--degrees 1] [--length 0.005]

--parts simulates six views of each mesh (in metres) on a table, with 1 mm of noise. It prints the median and 90 %
distance of a session's points from the surface, in millimetres, for exact poses, poses with the error, corrected poses,
and corrected exact poses. --recording adds the error to the poses of a recording, and prints the disagreement of its
views, the remaining error, and the seconds of the alignment.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.geometry.frame import Frame
from jaxnbv.planning.alignment import Alignment
from jaxnbv.planning.images import stride_of
from jaxnbv.readers.recorded import RecordedFrames
from jaxnbv.scanning import TriangleMesh

_CAMERA, _DISTANCE, _NOISE = nbv.Camera(height=240, width=320, fov=0.7), 0.5, 1e-3
_ELEVATIONS, _AZIMUTHS = np.radians([35, 50, 30, 60, 40, 55]), np.radians([0, 60, 130, 190, 250, 310])
_BOX_MARGIN = np.array([0.02, 0.02, 0.0])
_NUM_POINTS = 40_000


def error_of(seed: int, degrees: float, length: float) -> np.ndarray:
    """A rotation and a translation of these sizes about and along random axes, 4 x 4."""
    axis, shift = np.random.default_rng(seed).normal(size=(2, 3))
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    matrix[:3, 3] = length * shift / np.linalg.norm(shift)
    return matrix


def on_a_table(file: Path) -> trimesh.Trimesh:
    """A mesh in its likeliest resting pose, with its middle over the origin, a millimetre above the table."""
    file_mesh = trimesh.load(file, force="mesh")
    mesh = trimesh.Trimesh(file_mesh.vertices, file_mesh.faces, process=False)
    mesh.apply_transform(trimesh.poses.compute_stable_poses(mesh.convex_hull)[0][0])
    low, high = mesh.bounds
    return mesh.apply_translation([*(-0.5 * (low + high)[:2]), 0.001 - low[2]])


def views_of(mesh: trimesh.Trimesh, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Depth images and pose matrices of cameras around a mesh on a table."""
    table = trimesh.creation.box((1.0, 1.0, 0.02), trimesh.transformations.translation_matrix((0.0, 0.0, -0.01)))
    mesh_and_table = trimesh.util.concatenate([mesh, table])
    world = TriangleMesh(
        np.asarray(mesh_and_table.vertices, np.float32), np.asarray(mesh_and_table.faces, np.int32), Frame()
    )
    random, views = np.random.default_rng(seed), []
    for elevation, azimuth in zip(_ELEVATIONS, _AZIMUTHS + random.uniform(0.0, 2.0 * np.pi), strict=True):
        position = _DISTANCE * np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        pose = nbv.look_at(position, (0.0, 0.0, 0.03), up=(0.0, 0.0, 1.0))
        cloud = nbv.scan(world, _CAMERA, pose)
        depth = (np.asarray(cloud.points) - np.asarray(pose.position)) @ np.asarray(pose.forward)
        depth = np.where(cloud.mask, depth + _NOISE * random.standard_normal(depth.shape), 0.0)
        views.append((depth.reshape(_CAMERA.height, _CAMERA.width), np.asarray(pose.to_matrix(), np.float64)))
    return views


def of_parts(options: argparse.Namespace) -> None:
    files = sorted(options.parts.rglob("*.glb"))[: options.objects]
    columns = {
        "exact": (False, False),
        "exact, corrected": (False, True),
        "off": (True, False),
        "corrected": (True, True),
    }
    print(f"{'':24}", *(f"{name:>18}" for name in columns))
    rows = []
    for seed, file in enumerate(files):
        mesh, error = on_a_table(file), error_of(seed, options.degrees, options.length)
        surface = cKDTree(trimesh.sample.sample_surface(mesh, _NUM_POINTS, seed=0)[0])
        views, row = views_of(mesh, seed), []
        box = (mesh.bounds[0] - _BOX_MARGIN, mesh.bounds[1] + 0.02)
        for is_off, corrects in columns.values():
            session = nbv.Session(_CAMERA, np.stack(box), up="z", correct_mount=corrects or None, progress=False)
            for depth, matrix in views:
                session.add(depth, matrix @ np.linalg.inv(error) if is_off else matrix)
            distances = 1e3 * surface.query(session.cloud.to_numpy()[0])[0]
            row.append((np.median(distances), np.percentile(distances, 90)))
        rows.append(row)
        print(f"{file.stem:24}", *(f"{median:9.2f}{quantile:9.2f}" for median, quantile in row), flush=True)
    print(f"{'mean':24}", *(f"{median:9.2f}{quantile:9.2f}" for median, quantile in np.mean(rows, axis=0)))


def of_recording(options: argparse.Namespace) -> None:
    frames = RecordedFrames(options.recording)
    images = range(0, len(frames), options.every)
    stride = stride_of(frames.camera)

    def align(error: np.ndarray) -> tuple[Alignment, float]:
        poses = [nbv.Pose.from_matrix(frames.matrices[index] @ np.linalg.inv(error)) for index in images]
        clouds = [
            nbv.PointCloud.from_depth(frames.depth(index), frames.camera, pose, frames.depth_scale, stride)
            for index, pose in zip(images, poses, strict=True)
        ]
        start = time.perf_counter()
        alignment = nbv.align_views(clouds, poses)
        return alignment, time.perf_counter() - start

    for degrees, length in ((0.0, 0.0), (0.5, 0.001), (options.degrees, options.length), (3.0, 0.015)):
        error = error_of(0, degrees, length)
        alignment, seconds = align(error)
        remaining = np.linalg.inv(error) @ alignment.corrections[0]
        angle = np.degrees(Rotation.from_matrix(remaining[:3, :3]).magnitude())
        print(
            f"off by {degrees:.1f} degrees, {1e3 * length:.0f} mm: views disagree by "
            f"{1e3 * np.nanmedian(alignment.disagreement):.2f} mm, then {1e3 * np.nanmedian(alignment.corrected):.2f}; "
            f"one view scatters by {1e3 * alignment.noise:.2f}; left {angle:.2f} degrees, "
            f"{1e3 * np.linalg.norm(remaining[:3, 3]):.2f} mm; "
            f"{'' if alignment.is_determined else 'un'}determined; {seconds:.1f} s"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--parts", type=Path)
    source.add_argument("--recording", type=Path)
    parser.add_argument("--objects", default=10, type=int)
    parser.add_argument("--every", default=3, type=int)
    parser.add_argument("--degrees", default=1.0, type=float)
    parser.add_argument("--length", default=0.005, type=float)
    options = parser.parse_args()
    # Sessions warn of the table that they detect, and of the error in the poses, which is on purpose.
    warnings.simplefilter("ignore", UserWarning)
    of_parts(options) if options.parts else of_recording(options)


if __name__ == "__main__":
    main()
