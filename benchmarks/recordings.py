"""Coverage by new surface on recordings of known objects: simulated depth images of meshes, and the range scans of the
Stanford bunny, written as folders for `RecordedFrames`.

    python benchmarks/recordings.py --mesh FILE ... --work FOLDER [--above] [--starts 2] [--views 6]

Each object is a study of a recording (`jaxnbv study recorded`). Each start has another first view. The table has the
share of voxels seen after each view from the second on, mean over objects, and then the difference of new surface to
each other method, with paired 90 % intervals over objects. The last column is the mean over the views.
"""

import argparse
import itertools
import json
import math
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import trimesh
from PIL import Image

import jaxnbv as nbv
from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.planning.loop import Loop
from jaxnbv.readers.recorded import RecordedFrames
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.sensors import Setting, fit_distance
from jaxnbv.studies.engine.results import interval
from jaxnbv.studies.recorded import NEW_AREA, ORACLE, RecordedStudy

# 640 x 480 pixels, f = 600. Surface steeper than 75 degrees gives no return.
_INTRINSICS = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
_CAMERA = nbv.Camera(2.0 * math.atan(0.4), 480, 640, max_incidence=math.radians(75.0))
# In metres: longest side of an object, noise at a distance of 1, unit of the images.
_SIDE, _NOISE, _UNIT = 0.5, 1e-3, 1e-4
# Numbers of poses on the whole sphere, and on its upper half.
_NUM_AROUND, _NUM_ABOVE = 60, 40
_HALF_TABLE = 20.0
# Distance of the camera from the bunny in metres, and its focal length. The scanner's rays were nearly parallel.
_BUNNY_DISTANCE, _BUNNY_PIXELS = 1.0, 600.0


class Recorded(NamedTuple):
    """A recording: its name, its folder, the box of the study, and the upward axis of its world.

    - `mesh`: the object's true mesh, in the recording's world, or None.
    """

    name: str
    folder: Path
    box: tuple[float, ...] | None = None
    up: tuple[float, float, float] | None = None
    mesh: TriangleMesh | None = None


def of_mesh(file: Path, folder: Path, above: bool) -> Recorded:
    """A recording of a mesh, from all around, or with `above` on a table from the upper half. Written only once."""
    mesh = nbv.load_mesh(file)
    extents = np.ptp(mesh.vertices, axis=0)
    size = _SIDE / extents.max() * np.array([extents[0], extents[2], extents[1]])
    corners = np.array([[-0.5 * size[0], -0.5 * size[1], 0.0], [0.5 * size[0], 0.5 * size[1], size[2]]])
    frame = nbv.Frame.fit(corners, up="z")
    # The table's noise stays below the box.
    margin = np.array([[-0.03, -0.03, 0.02 if above else -0.03], [0.03, 0.03, 0.03]])
    box = tuple((corners + _SIDE * margin).reshape(-1).tolist())
    world_mesh = TriangleMesh(np.asarray(frame.to_world(mesh.vertices), np.float64), mesh.faces, nbv.Frame())
    recorded = Recorded(f"{file.stem}, {'above' if above else 'around'}", folder, box, mesh=world_mesh)
    if (folder / "frames.json").exists():
        return recorded
    if above:
        mesh = _on_table(mesh, -0.5 * extents[1])
    radius = fit_distance(Setting(_CAMERA, 1.0, 1), float(np.linalg.norm(extents)) / 2.0).radius
    count, lowest = (_NUM_ABOVE, math.radians(10.0)) if above else (_NUM_AROUND, -math.pi / 2)
    poses = nbv.look_at(fibonacci_sphere(count, radius, lowest))
    noise = nbv.DepthNoise(_NOISE, scale=frame.scale)
    images = []
    for index, pose in enumerate(poses):
        cloud = nbv.scan(mesh, _CAMERA, pose)
        depth = np.where(cloud.mask, (cloud.points - pose.position) @ pose.forward, 0.0)
        noisy_depth = noise.measured(depth, jax.random.key(index))
        images.append(np.asarray(noisy_depth, np.float64).reshape(_CAMERA.height, _CAMERA.width) / frame.scale)
    matrices = np.asarray(frame.to_world(poses).to_matrix(), np.float64)
    _write(folder, images, matrices, _INTRINSICS)
    return recorded


def of_bunny(file: Path, folder: Path) -> Recorded:
    """The ten range scans of the Stanford bunny, each rendered from a metre away."""
    recorded = Recorded("bunny", folder)
    if (folder / "frames.json").exists():
        return recorded
    data = np.load(file)
    ends = np.cumsum(data["count"])
    images, matrices = [], []
    for points, rotation, shift in zip(np.split(data["points_10um"], ends[:-1]), data["R"], data["t"], strict=True):
        scan_points = points * 1e-5
        middle = scan_points.mean(axis=0)
        # The scanner looks along -z with y up, the camera along z with y down.
        local = (scan_points - middle) * (1.0, -1.0, -1.0) + np.array([0.0, 0.0, _BUNNY_DISTANCE])
        column, row = np.round(_BUNNY_PIXELS * local[:, :2] / local[:, 2:] + 120.0).astype(int).T
        image = np.full((240, 240), np.inf)
        np.minimum.at(image, (row, column), local[:, 2])
        images.append(np.where(np.isfinite(image), image, 0.0))
        matrix = np.eye(4)
        matrix[:3, :3] = rotation @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = rotation @ (middle + np.array([0.0, 0.0, _BUNNY_DISTANCE])) + shift
        matrices.append(matrix)
    _write(
        folder, images, np.stack(matrices), np.array([[_BUNNY_PIXELS, 0, 120.5], [0, _BUNNY_PIXELS, 120.5], [0, 0, 1]])
    )
    return recorded


def _on_table(mesh: TriangleMesh, height: float) -> TriangleMesh:
    half = _HALF_TABLE
    corners = [[-half, height, -half], [half, height, -half], [half, height, half], [-half, height, half]]
    vertices = np.concatenate([mesh.vertices, corners])
    faces = np.concatenate([mesh.faces, len(mesh.vertices) + np.array([[0, 2, 1], [0, 3, 2]])])
    return TriangleMesh(vertices, faces, mesh.frame)


def _write(folder: Path, images: list[np.ndarray], matrices: np.ndarray, intrinsics: np.ndarray) -> None:
    """Write images, given in metres, with their poses and intrinsics."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, (image, matrix) in enumerate(zip(images, matrices, strict=True)):
        name = f"depth-{index:03}.png"
        Image.fromarray(np.clip(np.round(image / _UNIT), 0, 65534).astype(np.uint16)).save(folder / name)
        frames.append({"depth": name, "pose": matrix.tolist()})
    content = {"intrinsics": intrinsics.tolist(), "depth_scale": _UNIT, "frames": frames}
    (folder / "frames.json").write_text(json.dumps(content))


def area_shown(recorded: Recorded, count: int = 20_000) -> np.ndarray:
    """Whether each frame shows each of some points, uniform by area on the known mesh in the box: (frames, points).

    The study's voxels underestimate coverage: a voxel that the surface cuts at a corner gets few pixels of a frame.
    """
    assert recorded.mesh is not None
    assert recorded.box is not None
    mesh = trimesh.Trimesh(recorded.mesh.vertices, recorded.mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    is_inside = np.all((points >= recorded.box[:3]) & (points <= recorded.box[3:]), axis=1)
    points, normals = points[is_inside], mesh.face_normals[faces[is_inside]]
    image_centre = np.array([320.0, 240.0])
    masks = []
    for matrix in RecordedFrames(str(recorded.folder)).matrices:
        offset = points - matrix[:3, 3]
        distances = np.linalg.norm(offset, axis=1)
        directions, local = offset / distances[:, None], offset @ matrix[:3, :3]
        is_in_image = np.all(np.abs(600.0 * local[:, :2]) <= image_centre * local[:, 2:], axis=1)
        is_facing = -np.sum(directions * normals, axis=1) >= math.cos(_CAMERA.max_incidence)
        hits = recorded.mesh.trace(np.broadcast_to(matrix[:3, 3], offset.shape), directions)
        hit_distances = np.linalg.norm(np.asarray(hits.points) - matrix[:3, 3], axis=1)
        masks.append(
            is_in_image & is_facing & np.asarray(hits.mask) & (np.abs(hit_distances - distances) < 2e-3 * distances)
        )
    return np.array(masks)


def study_of(recorded: Recorded, views: int) -> RecordedStudy:
    options = {"folder": recorded.folder, "box": recorded.box, "up": recorded.up}
    return RecordedStudy.configured("screened", views, False, **options)[""]


def coverage_by_view(study: RecordedStudy, method: str, start: int) -> np.ndarray:
    """Share of the voxels seen after each view of a method."""
    scene = study.scene(start)
    first = study.recording.poses[study.first_view(scene)]
    loop = Loop(study.planner(method, scene), study.key(start, "episode"), camera=study.camera)
    steps = itertools.islice(loop.steps(study.sensor(scene), first), study.views)
    frames = [study.frame_of(step.view.pose) for step in steps]
    return np.logical_or.accumulate(study.recording.is_shown[frames]).mean(axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path, nargs="+", required=True)
    parser.add_argument("--work", type=Path, required=True, help="where recordings are made")
    parser.add_argument("--above", action="store_true")
    parser.add_argument("--starts", type=int, default=2)
    parser.add_argument("--views", type=int, default=6)
    args = parser.parse_args()
    curves: dict[str, list[np.ndarray]] = {method: [] for method in (NEW_AREA, "farthest", "random", ORACLE)}
    for file in args.mesh:
        # Each object has its own box, and so its own programs. Those of twenty exceed the limit of memory maps.
        jax.clear_caches()
        folder = args.work / f"{file.stem}-{'above' if args.above else 'around'}"
        study = study_of(of_mesh(file, folder, args.above), args.views)
        for method, rows in curves.items():
            rows.append(np.mean([coverage_by_view(study, method, start) for start in range(args.starts)], axis=0)[1:])
        print(file.stem, *(f"{method} {np.round(100 * rows[-1], 1)}" for method, rows in curves.items()), flush=True)
    new_area = np.array(curves[NEW_AREA])
    for method, rows in curves.items():
        print(f"{method:12}", np.round(100 * np.mean(rows, axis=0), 1))
    for method in ("farthest", "random"):
        differences = 100 * (new_area - np.array(curves[method]))
        differences = np.concatenate([differences, differences.mean(axis=1, keepdims=True)], axis=1)
        coverage = [
            f"{mean:.1f} [{low:.1f}, {high:.1f}]"
            for mean, low, high in zip(differences.mean(0), *interval(differences), strict=True)
        ]
        print(f"less {method:8}", "  ".join(coverage))


if __name__ == "__main__":
    main()
