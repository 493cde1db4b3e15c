"""The protocols by which peers report coverage, run here: how much of an object each view adds, and how long it takes.

    python benchmarks/peers.py pb-nbv --mesh FILE ... [--half] [--out FILE]
    python benchmarks/peers.py benbv --mesh FILE ... [--out FILE]

pb-nbv (Jia et al., RA-L 2025; settings of dspangpang/pb_nbv): shortest side 0.3 m, a camera of f = 696 pixels for
1280 x 720 at 0.9 m, the first view from (0.9, 0, 0), 800 random candidates on the sphere, or with --half on its upper
half, ten views; a surface point is covered within 5 mm. benbv (settings of leihui6/BENBV): diagonal 0.2, a camera of 70
degrees upward at 1.2, a random first view, fifteen views, several repeats; covered within 2 mm.

Covered: of 10,000 points of the surface, those that a ray of the sensor reaches before anything else, to the tolerance.
Views are planned with 40 x 40 rays of the part of the cone that holds the object; what counts is what the sensor sees.
All methods choose from the same candidates. `oracle` takes the view that truly adds most, `uniform` spreads its views
before it has seen anything. Continues after the last run in the file.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.storage.files import write_text
from jaxnbv.studies.engine.results import interval

METHODS = ("new surface", "farthest view", "random", "uniform", "oracle")
POINTS, CANDIDATES, RAYS = 10_000, 800, 40


class Protocol(NamedTuple):
    """Lengths in the protocol's own unit; `scale`: its units per unit of an object whose box has these sides."""

    scale: Callable[[np.ndarray], float]
    camera: nbv.Camera
    distance: float
    tolerance: float
    views: int
    repeats: int
    reported: tuple[int, ...]


PROTOCOLS = {
    "pb-nbv": Protocol(
        lambda sides: 0.3 / sides.min(),
        nbv.Camera.from_intrinsics([[696.0, 0, 640], [0, 696, 360], [0, 0, 1]], 720, 1280),
        0.9,
        0.005,
        views=10,
        repeats=1,
        reported=(3, 6, 10),
    ),
    "benbv": Protocol(
        lambda sides: 0.2 / np.linalg.norm(sides),
        nbv.Camera(np.radians(70.0), 720, 720),
        1.2,
        0.002,
        views=15,
        repeats=10,
        reported=(3, 6, 10, 15),
    ),
}


class Object(NamedTuple):
    """A mesh, the candidates about it, and which points of its surface each of them covers."""

    mesh: nbv.TriangleMesh
    poses: nbv.Pose
    covered: Bool[np.ndarray, "candidates points"]


def prepared(file: Path, protocol: Protocol, half: bool, seed: int) -> Object:
    mesh = nbv.load_mesh(file)
    unit = protocol.scale(np.ptp(mesh.vertices, axis=0))
    key = jax.random.key(seed)
    directions = np.array(jax.random.normal(key, (CANDIDATES, 3)), np.float64)
    directions[:, 1] = np.abs(directions[:, 1]) if half else directions[:, 1]
    if protocol.repeats == 1:
        directions[0] = (1.0, 0.0, 0.0)
    poses = nbv.look_at(protocol.distance / unit * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    points = mesh.sample_points(key, POINTS)
    covered = [
        seen(mesh, protocol.camera, pose, points, protocol.tolerance / unit)
        for pose in map(poses.__getitem__, range(CANDIDATES))
    ]
    return Object(mesh, poses, np.stack(covered))


def seen(
    mesh: nbv.TriangleMesh, camera: nbv.Camera, pose: nbv.Pose, points: Float[np.ndarray, "n 3"], tolerance: float
) -> Bool[np.ndarray, " n"]:
    """Which points lie in the image, with nothing before them by more than the tolerance."""
    origin, rotation = np.asarray(pose.position, np.float64), np.asarray(pose.rotation, np.float64)
    away = points - origin
    local = away @ rotation
    column, row = camera.to_pixels(local[:, :2] / local[:, 2:]).T
    inside = (column > 0) & (column < camera.width) & (row > 0) & (row < camera.height)
    hits = mesh.trace(np.broadcast_to(origin, away.shape), away / np.linalg.norm(away, axis=1, keepdims=True))
    gap = np.linalg.norm(np.asarray(hits.points, np.float64) - points, axis=1)
    return inside & np.asarray(hits.mask) & (gap < tolerance)


def planning_camera(thing: Object, sensor: nbv.Camera) -> nbv.Camera:
    """Of the sensor's cone the part that holds the object, or all of it where that is less; with fewer rays."""
    distance = float(np.linalg.norm(thing.poses.position[0]))
    needed = 2.0 * math.asin(min(1.05 * thing.mesh.bounding_radius / distance, 1.0))
    whole = sensor.resized(RAYS, round(RAYS * sensor.width / sensor.height))
    return nbv.Camera(needed, RAYS, RAYS) if needed < sensor.fov else whole


def planned(
    thing: Object, camera: nbv.Camera, search: nbv.Search, first: int, views: int, seed: int
) -> tuple[list[int], list[float]]:
    """The candidates that a planner takes, and seconds for each choice after those that compile."""
    imagination = nbv.Imagination(grid=nbv.Grid(64), num_samples=8)
    planner = nbv.Planner(nbv.NewSurface(), search, camera, imagination, capacity=2048, max_views=views)
    key, places = jax.random.key(seed), np.asarray(thing.poses.position, np.float64)
    pose, taken, seconds = thing.poses[first], [first], []
    evidence = planner.init(pose, nbv.scan(thing.mesh, camera, pose))
    while len(taken) < views:
        start = time.perf_counter()
        pose = jax.block_until_ready(planner.propose(evidence, jax.random.fold_in(key, len(taken)))).pose
        seconds.append(time.perf_counter() - start)
        taken.append(int(np.argmin(np.linalg.norm(places - np.asarray(pose.position), axis=1))))
        evidence = planner.observe(evidence, pose, nbv.scan(thing.mesh, camera, pose))
    return taken, seconds[2:]


def greedy(thing: Object, first: int, views: int) -> list[int]:
    taken, known = [first], thing.covered[first].copy()
    while len(taken) < views:
        taken.append(int(np.argmax(np.sum(thing.covered & ~known, axis=1))))
        known |= thing.covered[taken[-1]]
    return taken


def uniform(thing: Object, first: int, views: int) -> list[int]:
    """The candidates nearest to a lattice of as many places."""
    radius = float(np.linalg.norm(thing.poses.position[0]))
    lattice = np.asarray(nbv.fibonacci_sphere(views, radius), np.float64)
    if np.asarray(thing.poses.position)[:, 1].min() >= 0:
        lattice[:, 1] = np.abs(lattice[:, 1])
    away = np.linalg.norm(np.asarray(thing.poses.position)[None] - lattice[:, None], axis=2)
    return [first, *np.argmin(away, axis=1)[: views - 1].tolist()]


def run(thing: Object, protocol: Protocol, seed: int) -> dict:
    """Of each method the coverage after each view, and the seconds a choice of those that plan."""
    camera = planning_camera(thing, protocol.camera)
    first = 0 if protocol.repeats == 1 else int(jax.random.randint(jax.random.key(seed), (), 0, CANDIDATES))
    views, found = protocol.views, {}
    searches = {"new surface": nbv.HalvingSearch(thing.poses), "farthest view": nbv.FarthestView(thing.poses)}
    searches |= {"random": nbv.RandomView(thing.poses)}
    for method in METHODS:
        seconds: list[float] = []
        if method in searches:
            taken, seconds = planned(thing, camera, searches[method], first, views, seed)
        else:
            taken = (greedy if method == "oracle" else uniform)(thing, first, views)
        covered = np.mean(np.logical_or.accumulate(thing.covered[taken], axis=0), axis=1)
        found[method] = {"covered": covered.tolist(), "seconds": float(np.mean(seconds)) if seconds else None}
    return found


def table(records: dict, protocol: Protocol) -> str:
    """Coverage in percent after some views, the mean over all views, and seconds a choice; means over objects."""
    by_object: dict[str, list[dict]] = {}
    for name, record in records.items():
        by_object.setdefault(name.rpartition(" ")[0], []).append(record)
    heads = [*(f"view {view}" for view in protocol.reported), "all views"]
    lines = [f"{len(by_object)} objects, {protocol.repeats} runs each; percent covered, 90 % intervals over objects"]
    lines.append(f"{'':14}" + "".join(f"{head:>20}" for head in heads) + f"{'seconds a view':>16}")
    for method in METHODS:
        curves = np.array([np.mean([one[method]["covered"] for one in of], axis=0) for of in by_object.values()])
        columns = np.column_stack([*(curves[:, view - 1] for view in protocol.reported), curves.mean(axis=1)])
        low, high = interval(columns)
        cells = zip(100 * columns.mean(axis=0), 100 * low, 100 * high, strict=True)
        took = [one[method]["seconds"] for of in by_object.values() for one in of]
        second = f"{np.mean(took):16.2f}" if took[0] is not None else ""
        lines.append(f"{method:14}" + "".join(f"{a:6.1f} [{b:5.1f},{c:6.1f}]" for a, b, c in cells) + second)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("protocol", choices=PROTOCOLS)
    parser.add_argument("--mesh", nargs="+", type=Path, required=True, help="mesh files")
    parser.add_argument("--half", action="store_true", help="candidates on the upper half alone")
    parser.add_argument("--repeats", type=int, help="runs of each object; default: the protocol's")
    parser.add_argument("--out", type=Path, help="default: runs/peers-PROTOCOL[-half].json")
    asked = parser.parse_args()
    protocol = PROTOCOLS[asked.protocol]
    protocol = protocol if asked.repeats is None else protocol._replace(repeats=asked.repeats)
    out = asked.out or Path("runs") / f"peers-{asked.protocol}{'-half' if asked.half else ''}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    records = json.loads(out.read_text()) if out.exists() else {}
    for file in tqdm(asked.mesh, desc="objects"):
        names = [f"{file.stem} {repeat}" for repeat in range(protocol.repeats)]
        if all(name in records for name in names):
            continue
        thing = prepared(file, protocol, asked.half, sum(map(ord, file.stem)))
        for repeat, name in enumerate(names):
            if name not in records:
                records[name] = run(thing, protocol, repeat)
                write_text(out, json.dumps(records))
    print(table(records, protocol))


if __name__ == "__main__":
    main()
