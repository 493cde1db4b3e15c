"""Poses that an arm reaches, its time in motion, and the accuracy of its scans, in a simulator.

    python benchmarks/arm.py --parts FOLDER [--objects 10] [--views 6] [--degrees 1] [--millimetres 5]

Each mesh (in metres) stands on a table. Methods are new surface with motion as its cost, farthest view among the poses
that the arm reaches, and new surface with an error in the camera's mount, without and with its correction. Columns are
the share of proposals that the arm reaches, the seconds of motion, the share of the surface within 3 mm of a measured
point, and the median and 90 % quantile of the distances between points and object in millimetres.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
import trimesh

import jaxnbv as nbv

sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
from arm_simulator import Arm, on_a_table
from mujoco_arm import box_about, distances_mm, hand_eye_error, scan_object

_MAX_DISTANCE, _NUM_POINTS = 0.003, 4000


def planner_of(search: nbv.DiscreteSearch | nbv.FarthestView) -> nbv.Planner:
    sampler = nbv.SurfaceSampler(num_samples=8)
    return nbv.Planner(nbv.NewSurface(), search, nbv.Camera(height=24, width=32), sampler, capacity=4000)


def row_of(mesh: trimesh.Trimesh, views: int, search, error: np.ndarray, corrects: bool, counts_motion: bool) -> list:
    arm = Arm(mesh, error)

    def reachable(matrices: np.ndarray) -> list:
        answers = arm.reachable(matrices)
        return answers if counts_motion else [isinstance(answer, float) or answer for answer in answers]

    scan = scan_object(arm, box_about(mesh), planner_of(search), views, None, corrects, reachable)
    points = nbv.viz.scanned_cloud(scan.session.episode).to_numpy()[0]
    surface = trimesh.sample.sample_surface(mesh, _NUM_POINTS, seed=0)[0]
    is_covered = trimesh.PointCloud(points).kdtree.query(surface)[0] < _MAX_DISTANCE
    num_refused = sum(scan.refusals.values())
    rows = np.random.default_rng(0).choice(len(points), min(len(points), _NUM_POINTS), replace=False)
    return [
        scan.proposals / (scan.proposals + num_refused),
        arm.seconds,
        is_covered.mean(),
        *distances_mm(points[rows], mesh),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=Path, required=True)
    parser.add_argument("--objects", default=10, type=int)
    parser.add_argument("--views", default=6, type=int)
    parser.add_argument("--degrees", default=1.0, type=float)
    parser.add_argument("--millimetres", default=5.0, type=float)
    options = parser.parse_args()
    # Sessions warn of the table that they detect, and of the error in the mount, which is on purpose.
    warnings.simplefilter("ignore", UserWarning)
    nbv.keep_compiled()
    no_error, mount_error = np.eye(4), hand_eye_error(options.degrees, options.millimetres)
    discrete, farthest = (kind(nbv.Reach(160)) for kind in (nbv.DiscreteSearch, nbv.FarthestView))
    columns = {
        "new surface": (discrete, no_error, False, True),
        "farthest": (farthest, no_error, False, False),
        "mount off": (discrete, mount_error, False, True),
        "corrected": (discrete, mount_error, True, True),
    }
    print(f"{'':24}", *(f"{name:^37}" for name in columns))
    print(f"{'':24}", *(f"{'reached':>8}{'s':>7}{'seen':>7}{'mm':>7}{'90 %':>7} " for _ in columns))
    rows = []
    for file in sorted(options.parts.rglob("*.glb"))[: options.objects]:
        mesh = on_a_table(file)
        rows.append([row_of(mesh, options.views, *column) for column in columns.values()])
        _print(file.stem, rows[-1])
    _print("mean", np.mean(rows, axis=0))


def _print(name: str, row: list) -> None:
    cells = (f"{fraction:8.0%}{s:7.1f}{seen:7.0%}{mm:7.2f}{quantile:7.2f} " for fraction, s, seen, mm, quantile in row)
    print(f"{name:24}", *cells, flush=True)


if __name__ == "__main__":
    main()
