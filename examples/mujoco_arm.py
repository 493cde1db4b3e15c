"""A robot arm scans an object in a simulator, from the first image to a mesh:

    pip install "jaxnbv[arm]"
    python examples/mujoco_arm.py [FILE] --gif arm.gif

`FILE` is a mesh in metres, by default a mug. The arm is in `arm_simulator.py`. A real arm runs the same loop,
`scan_object`. At the end the measured points and the mesh are compared with the object, in millimetres.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np
import trimesh
from arm_simulator import PLACE, Arm, on_a_table
from scipy.spatial.transform import Rotation

import jaxnbv as nbv

# Margin of the box around the object, except below it.
ROOM = 0.015


def box_about(mesh: trimesh.Trimesh) -> np.ndarray:
    """Two corners of the box to scan."""
    return np.array([mesh.bounds[0] - [ROOM, ROOM, 0.0], mesh.bounds[1] + ROOM])


class Scan(NamedTuple):
    """A scanned object.

    - `session`: the session, with its images.
    - `refusals`: numbers of poses that the arm could not reach, by reason.
    - `proposals`: number of poses that the session proposed.
    """

    session: nbv.Session
    refusals: Counter[str]
    proposals: int


def scan_object(
    arm: Arm,
    box: np.ndarray,
    planner: nbv.Planner | None = None,
    views: int = 12,
    until: nbv.StopRule | None = None,
    correct_mount: bool = False,
    reachable: Callable[[np.ndarray], list] | None = None,
    moved: Callable[[nbv.Session, list[np.ndarray]], None] = lambda session, way: None,
) -> Scan:
    """Scan the object in a box until the session is done.

    - `reachable`: see `nbv.Session`. By default the arm's own scores.
    - `moved`: called with the session and the postures of each motion, after the image at its end is added.
    """
    session = nbv.Session(
        arm.camera,
        box,
        planner,
        up="z",
        until=until,
        reachable=reachable or arm.reachable,
        correct_mount=correct_mount,
        ignore=arm.is_own,
    )
    center, refusals, proposals = box.mean(axis=0), Counter(), 0
    first = nbv.look_at(center + np.array([-0.2, -0.05, 0.25]), center, up=(0.0, 0.0, 1.0))
    matrix = np.asarray(first.matrix, np.float64)
    while True:
        way = arm.go_to(matrix)
        session.add(arm.depth(), arm.matrix())
        moved(session, way)
        if len(session.views) == views or session.done() is not None:
            return Scan(session, refusals, proposals)
        view = session.next()
        refusals.update(view.refusals)
        proposals += 1
        matrix = view.matrix


def hand_eye_error(degrees: float, millimetres: float) -> np.ndarray:
    """A rotation about one axis and a translation along another, 4 x 4."""
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, -0.64, 0.48])).as_matrix()
    error[:3, 3] = 1e-3 * millimetres * np.array([0.48, 0.6, -0.64])
    return error


def distances_mm(points: np.ndarray, mesh: trimesh.Trimesh) -> tuple[float, float]:
    """Median and 90 % quantile of the distances of points from the object's surface, in millimetres."""
    squared, _, _ = igl.point_mesh_squared_distance(points, mesh.vertices, mesh.faces)
    away = 1e3 * np.sqrt(squared)
    return float(np.median(away)), float(np.percentile(away, 90))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, help="a mesh in metres; a mug by default")
    parser.add_argument("--views", default=12, type=int, help="most images that are taken")
    parser.add_argument("--covered", default=0.9, type=float, help="stop once this share of the surface is seen")
    parser.add_argument("--hand-eye", nargs=2, default=(0.0, 0.0), type=float, metavar=("DEGREES", "MM"))
    parser.add_argument("--correct", action="store_true", help="correct the poses by what the images tell")
    parser.add_argument("--gif", type=Path, help="draw the arm at work")
    parser.add_argument("--mesh", default="scan.ply", type=Path, help="where the mesh goes")
    options = parser.parse_args()
    nbv.keep_compiled()
    mesh = on_a_table(options.file)
    box = box_about(mesh)
    arm = Arm(mesh, hand_eye_error(*options.hand_eye))
    frames = None
    if options.gif:
        from arm_pictures import Frames

        frames = Frames(arm, PLACE)
    planner = nbv.Planner(
        nbv.NewSurface(),
        nbv.DiscreteSearch(nbv.Reach(160)),
        nbv.Camera(height=24, width=32),
        nbv.SurfaceSampler(num_samples=8),
        capacity=4000,
    )

    def moved(session: nbv.Session, way: list[np.ndarray]) -> None:
        print(session, f"after {arm.seconds:.0f} s of motion", flush=True)
        if frames is not None:
            frames.draw(session, way)

    scan = scan_object(arm, box, planner, options.views, nbv.Covered(options.covered), options.correct, moved=moved)
    session, episode = scan.session, scan.session.episode
    print(session.done() or f"{options.views} images are taken", "; refused poses:", dict(scan.refusals))
    nbv.save_mesh(episode, options.mesh, imagined=False)
    points = nbv.viz.scanned_cloud(episode).to_numpy()[0]
    for name, places in (("points", points[::10]), ("mesh", trimesh.load(options.mesh).vertices)):
        print(f"{name}: median {{:.2f}} mm, 90 % {{:.2f}} mm from the object".format(*distances_mm(places, mesh)))
    if frames is not None:
        frames.save(options.gif)


if __name__ == "__main__":
    main()
