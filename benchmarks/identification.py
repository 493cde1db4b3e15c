"""Calibration of identified names: right names and their probabilities under a real sensor's noise, with an error in
the camera's mount, and for objects that are not in the bank.

    python benchmarks/identification.py --parts FOLDER [--setup whole] [--scenes 8] [--views 2] [--odd]
        [--noise 1.4] [--mount 0.5] [--others FOLDER | --left-out]

The files of parts are in metres. Views are random. Noise is along the rays, in millimetres; normals are off by 8
degrees. --mount turns every camera by the same angle, in degrees, about an axis of the camera. With --others the
objects are from that folder, at 8 to 25 cm, and none is in the bank. With --left-out each object is a part that is left
out of the bank. Scenes of even and of odd numbers share no parts.

Columns, after each view: *right*, percent of likeliest names that are right ("none of these" for objects that are not
in the bank); *probability* of the likeliest name. Below: the expected calibration error over all views, in ten bins.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import TriangleMesh, scan
from jaxnbv.studies.engine.study import Scene
from jaxnbv.studies.identification import IDENTIFY, IdentificationStudy
from jaxnbv.studies.scenes.framing import Setup
from jaxnbv.studies.scenes.placed_parts import Parts, parts_in, place_part
from jaxnbv.surfaces.part_hypotheses import NONE

# Longest sides of objects of --others in metres, error of normals in radians, axis of the mount's error.
_SIDES, _NORMAL_NOISE, _MOUNT_AXIS = (0.08, 0.25), 0.15, np.array([0.6, 0.64, 0.48])
_BINS = 10


def other_scene(study: IdentificationStudy, index: int, files: list[Path]) -> Scene:
    """An object of another folder, placed like the parts."""
    random, parts = np.random.default_rng(500 + index), parts_in(study.meshes)
    file = files[int(random.integers(len(files)))]
    file_mesh = trimesh.load(file, force="mesh")
    vertices = np.asarray(file_mesh.vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - 0.5 * (low + high)) / (high - low).max() * random.uniform(*_SIDES)
    mesh = TriangleMesh(vertices.astype(np.float32), np.asarray(file_mesh.faces, np.int32), Frame())
    # The resting pose of the object does not matter, since the hypotheses are the bank's parts.
    placed_part = place_part(
        Parts(parts.bank, (*parts.meshes, mesh)), len(parts.bank), study.setup, study.key(index, "scene")
    )
    return Scene(index, file.stem, placed_part.mesh, placed_part)


def image_of(
    study: IdentificationStudy, scene: Scene, pose: Pose, noise: float, mount: float, seed: int
) -> tuple[PointCloud, Pose]:
    """A noisy scan, and the pose that the robot reports for it."""
    true_scan, random = scan(scene.surface, study.camera, pose), np.random.default_rng(seed)
    mask, place = np.asarray(true_scan.mask)[:, None], np.asarray(pose.position)
    rays = np.asarray(true_scan.points) - place
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    range_noise = 1e-3 * noise * scene.task.scale * random.standard_normal((len(rays), 1))
    normals = np.asarray(true_scan.normals) + _NORMAL_NOISE * random.standard_normal(rays.shape)
    rotation = np.asarray(pose.rotation)
    reported_rotation = rotation @ Rotation.from_rotvec(np.radians(mount) * _MOUNT_AXIS).as_matrix()
    error_rotation = reported_rotation @ rotation.T
    points = np.where(mask, (np.asarray(true_scan.points) + range_noise * rays - place) @ error_rotation.T + place, 0.0)
    normals = normals @ error_rotation.T / np.linalg.norm(normals, axis=1, keepdims=True)
    sight = np.asarray(true_scan.sight) + range_noise[:, 0]
    noisy = {"points": points, "normals": np.where(mask, normals, 0.0), "sight": sight}
    cloud = dataclasses.replace(true_scan, **{name: jnp.asarray(rows, jnp.float32) for name, rows in noisy.items()})
    return cloud, Pose(jnp.asarray(reported_rotation, jnp.float32), pose.position)


def beliefs(
    study: IdentificationStudy, planner: Planner, scene: Scene, options: argparse.Namespace
) -> Iterator[dict[str, float]]:
    """The identity after each view."""
    poses, random = study.candidates.poses(), np.random.default_rng(77 + scene.index)
    first = int(study.first_view(scene))
    others = random.choice(np.delete(np.arange(study.num_candidates), first), options.views - 1, replace=False)
    observations = None
    for number in [first, *others.tolist()]:
        pose = jax.tree.map(lambda rows, index=number: rows[index], poses)
        seed = 1000 * scene.index + number
        cloud, reported_pose = image_of(study, scene, pose, options.noise, options.mount, seed)
        if observations is None:
            observations = planner.init(reported_pose, cloud, study.camera)
        else:
            observations = planner.observe(observations, reported_pose, cloud, study.camera)
        yield observations.hypotheses.names()


def calibration_error(rows: np.ndarray) -> float:
    """Expected calibration error of rows (probability, whether it was right), by the numbers of rows in the bins."""
    bins = np.minimum((_BINS * rows[:, 0]).astype(int), _BINS - 1)
    return sum(abs(np.sum(rows[bins == index, 0] - rows[bins == index, 1])) for index in range(_BINS)) / len(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", required=True, type=Path)
    parser.add_argument("--setup", default=Setup.WHOLE, type=Setup, choices=[Setup.WHOLE, Setup.CLOSE_UP])
    for name, default in {"scenes": 8, "views": 2}.items():
        parser.add_argument(f"--{name}", default=default, type=int)
    for name, default in {"noise": 1.4, "mount": 0.0}.items():
        parser.add_argument(f"--{name}", default=default, type=float)
    parser.add_argument("--others", type=Path)
    parser.add_argument("--left-out", action="store_true")
    parser.add_argument("--odd", action="store_true")
    options = parser.parse_args()
    (study,) = IdentificationStudy.configured("known", options.views, False, options.parts, options.setup).values()
    files = [] if options.others is None else sorted(options.others.rglob("*.glb"))
    rows = []
    for index in range(int(options.odd), 2 * options.scenes, 2):
        scene = other_scene(study, index, files) if files else study.scene(index)
        planner, name = study.planner(IDENTIFY, scene), NONE if files or options.left_out else scene.name
        if options.left_out:
            bank = scene.task.bank.select([part for part in range(len(scene.task.bank)) if part != scene.task.part])
            planner = dataclasses.replace(planner, sampler=study.sampler.with_bank(bank, scene.task.poses))
        likeliest = [next(iter(belief.items())) for belief in beliefs(study, planner, scene, options)]
        rows.append([(probability, float(answer == name)) for answer, probability in likeliest])
        print(f"{scene.name:24}", *(f"{answer} {probability:.2f}" for answer, probability in likeliest), flush=True)
    table = np.array(rows)
    for title, column in {"right": 1, "probability": 0}.items():
        print(f"{title:24}", *(f"{100 * value:.0f}" for value in table[..., column].mean(axis=0)))
    print(f"calibration error {calibration_error(table.reshape(-1, 2)):.3f}")


if __name__ == "__main__":
    main()
