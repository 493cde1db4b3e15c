"""Coverage after each view, and time of a choice, by the experimental protocols of other papers.

    python benchmarks/peers.py pb-nbv --mesh FILE ... [--half] [--up z] [--out FILE]
    python benchmarks/peers.py benbv --mesh FILE ... [--up z] [--out FILE]

pb-nbv (Jia et al., RA-L 2025; settings of dspangpang/pb_nbv): shortest side 0.3 m; a camera of f = 696 pixels for
1280 x 720 at 0.9 m; the first view from (0.9, 0, 0); 800 random candidates on the sphere, or with --half on its upper
half; ten views; tolerance 5 mm. benbv (settings of leihui6/BENBV): diagonal 0.2 m; a camera of 70 degrees for 720 rows
at 1.2 m, with a depth resolution of 1 mm; a random first view from above; fifteen views; ten repeats; tolerance 2 mm;
clouds with one point a voxel, whose size is the distance between neighbouring rays.

Coverage is the share of the surface's points that have a scanned point within the tolerance. `new surface` and
`farthest view` plan with 40 x 40 rays through the part of the image that holds the object. The scans that count have
the sensor's resolution, in pb-nbv every other row and column. `oracle` takes the candidate that truly adds most.
`uniform` spreads its views evenly without looking at scans. Continues after the last run in the file, which must have
the same settings.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from covering import CANDIDATES, Look, Protocol, Trial, boundary_views
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.storage.files import write_text
from jaxnbv.studies.engine.results import interval

NUM_SCORED = 200
CAPACITY, SAMPLES = 2048, 16

_D435 = nbv.Camera.from_intrinsics([[696.0, 0, 640], [0, 696, 360], [0, 0, 1]], 720, 1280)
_WIDE = nbv.Camera(math.radians(70.0), 720, 1280)
PROTOCOLS = {
    "pb-nbv": Protocol(
        scale=lambda sides: 0.3 / float(sides.min()),
        camera=_D435,
        stride=2,
        distance=0.9,
        tolerance=0.005,
        step=0.0,
        voxel=0.0,
        points=10_000,
        views=10,
        repeats=1,
        reported_views=(3, 6, 10),
    ),
    "benbv": Protocol(
        scale=lambda sides: 0.2 / float(np.linalg.norm(sides)),
        camera=_WIDE,
        stride=1,
        distance=1.2,
        tolerance=0.002,
        step=0.001,
        voxel=1.2 / _WIDE.focal_lengths[1],
        points=60_000,
        views=15,
        repeats=10,
        reported_views=(3, 6, 10, 15),
    ),
}
METHODS = {
    "pb-nbv": ("new surface", "farthest view", "random", "uniform", "oracle"),
    "benbv": (
        *("new surface", "farthest view", "random sphere", "uniform sphere"),
        *("random boundary", "boundary oracle", "oracle"),
    ),
}


def plan(trial: Trial, search: nbv.search.Search, rays: int, first: int, seed: int) -> tuple[list[int], list[float]]:
    """The candidates that a planner chooses, and the seconds of each choice that does not compile."""
    distance = float(np.linalg.norm(trial.poses.position[0]))
    fov = 2.0 * math.asin(min(1.05 * trial.mesh.bounding_radius / distance, 1.0))
    # Rounded up, so that objects of similar size share their programs.
    fov = math.radians(5.0) * math.ceil(fov / math.radians(5.0))
    camera = nbv.Camera(min(fov, trial.protocol.camera.fov), rays, rays)
    planner = nbv.Planner(
        nbv.NewSurface(),
        search,
        camera,
        nbv.SurfaceSampler(num_samples=SAMPLES),
        capacity=CAPACITY,
        max_views=trial.protocol.views,
    )
    key, positions = jax.random.key(seed), np.asarray(trial.poses.position, np.float64)
    pose, indices, seconds = trial.poses[first], [first], []
    observations = planner.init(pose, nbv.scan(trial.mesh, camera, pose))
    while len(indices) < trial.protocol.views:
        start = time.perf_counter()
        pose = jax.block_until_ready(planner.propose(observations, jax.random.fold_in(key, len(indices)))).pose
        seconds.append(time.perf_counter() - start)
        indices.append(int(np.argmin(np.linalg.norm(positions - np.asarray(pose.position), axis=1))))
        observations = planner.observe(observations, pose, nbv.scan(trial.mesh, camera, pose))
    return indices, seconds[2:]


def greedy(trial: Trial, first: int) -> list[int]:
    """The candidates that truly add most, among those that `new surface` scores."""
    candidates = spread(trial.poses)
    covers, indices, covered = trial.covers(candidates.tolist()), [first], trial.covers([first])[0]
    while len(indices) < trial.protocol.views:
        best = int(np.argmax(np.sum(covers & ~covered, axis=1)))
        covered, indices = covered | covers[best], [*indices, int(candidates[best])]
    return indices


def uniform(trial: Trial, first: int) -> list[int]:
    """The candidates nearest to an even lattice with one place for each view."""
    places = np.asarray(trial.poses.position, np.float64)
    lattice = np.array(
        nbv.geometry.fibonacci_sphere(trial.protocol.views, float(np.linalg.norm(places[0]))), np.float64
    )
    if trial.half:
        lattice[:, 1] = np.abs(lattice[:, 1])
    nearest = np.argmin(np.linalg.norm(places[None] - lattice[:, None], axis=2), axis=1)
    return [first, *nearest[: trial.protocol.views - 1].tolist()]


def from_sphere(trial: Trial, first: int, angles: Float[np.ndarray, "views 2"]) -> list[Bool[np.ndarray, " points"]]:
    """Coverage of the first view, and of views from polar angles and azimuths on BENBV's larger sphere of 1.5 m."""
    polar, azimuth = angles.T
    x, y, z = np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)
    poses = nbv.look_at(1.5 / trial.unit * np.stack([x, y, z], axis=1))
    return [*trial.covers([first]), *(trial.look(poses[index]).covers for index in range(len(angles)))]


def beyond_boundary(trial: Trial, first: int, seed: int, best: bool) -> list[Bool[np.ndarray, " points"]]:
    """Coverage of views beyond the boundary, of which there are twenty. Takes a random one, or the best by BENBV's
    score of its true scan, which weighs new coverage against overlap with the scanned surface."""
    random, look = np.random.default_rng(seed), trial.look(trial.poses[first])
    covered, normals, coverage = look.covers.copy(), look.normals, [look.covers]
    while len(coverage) < trial.protocol.views:
        targets, directions = boundary_views(trial.points[covered], normals[covered], int(random.integers(2**31)))
        if len(targets) == 0:
            break
        offsets = trial.protocol.distance / trial.unit * directions
        poses = [nbv.look_at(target + offset, target) for target, offset in zip(targets, offsets, strict=True)]
        looks = [trial.look(pose) for pose in (poses if best else [poses[int(random.integers(len(poses)))]])]
        look = max(looks, key=lambda candidate: score(trial, candidate, covered))
        covered, normals = covered | look.covers, np.where(covered[:, None], normals, look.normals)
        coverage.append(look.covers)
    return coverage


def score(trial: Trial, look: Look, is_covered: Bool[np.ndarray, " points"]) -> float:
    """BENBV's score: w coverage + (1 - w) f(overlap), w = 1 / (1 + exp(-10 (covered - 0.5)))."""
    if len(look.cloud) == 0:
        return 0.0
    reach = trial.protocol.tolerance / trial.unit
    overlap = np.mean(np.isfinite(cKDTree(trial.points[is_covered]).query(look.cloud, distance_upper_bound=reach)[0]))
    worth = 5 * overlap - 6.25 * overlap**2 if overlap < 0.4 else 1.0 if overlap < 0.5 else 4 * overlap * (1 - overlap)
    weight = 1.0 / (1.0 + math.exp(-10.0 * (np.mean(is_covered) - 0.5)))
    return float(weight * np.mean(is_covered | look.covers) + (1.0 - weight) * worth)


def spread(poses: nbv.Pose) -> Int[np.ndarray, " some"]:
    """Indices of `NUM_SCORED` candidates, by farthest point sampling."""
    return np.asarray(farthest_point_indices(poses.position, np.ones(CANDIDATES, bool), NUM_SCORED))


def run(trial: Trial, methods: tuple[str, ...], rays: int, seed: int) -> dict:
    """Coverage of each method after each view, and the seconds of a choice for planning methods."""
    protocol, random, results = trial.protocol, np.random.default_rng(seed), {}
    above = np.asarray(trial.poses.position)[:, 1] >= 0
    first = 0 if protocol.repeats == 1 else int(random.choice(np.nonzero(above)[0]))
    lattice = np.radians([(polar, azimuth) for polar in range(30, 180, 30) for azimuth in range(0, 360, 45)])
    num_more = protocol.views - 1
    coverage_of_method: dict[str, Callable] = {
        "random": lambda: trial.covers(
            [first, *random.choice(np.arange(1, CANDIDATES), num_more, replace=False).tolist()]
        ),
        "uniform": lambda: trial.covers(uniform(trial, first)),
        "oracle": lambda: trial.covers(greedy(trial, first)),
        "random sphere": lambda: from_sphere(trial, first, random.uniform((0, 0), (np.pi, 2 * np.pi), (num_more, 2))),
        "uniform sphere": lambda: from_sphere(trial, first, random.permutation(lattice)[:num_more]),
        "random boundary": lambda: beyond_boundary(trial, first, seed, best=False),
        "boundary oracle": lambda: beyond_boundary(trial, first, seed, best=True),
    }
    searches = {
        "new surface": nbv.DiscreteSearch(trial.poses[spread(trial.poses)]),
        "farthest view": nbv.FarthestView(trial.poses),
    }
    for method in methods:
        seconds: list[float] = []
        if method in searches:
            indices, seconds = plan(trial, searches[method], rays, first, seed)
            coverage = trial.covers(indices)
        else:
            coverage = np.stack(coverage_of_method[method]())
        covered = np.mean(np.logical_or.accumulate(coverage, axis=0), axis=1)
        covered = np.pad(covered, (0, protocol.views - len(covered)), mode="edge")
        results[method] = {"covered": covered.tolist(), "seconds": float(np.mean(seconds)) if seconds else None}
    return results


def table(records: dict, methods: tuple[str, ...], protocol: Protocol) -> str:
    """Coverage in percent after some views, its mean over all views, the lead of the first method in that mean, and
    seconds of a choice. All are means over objects."""
    by_object: dict[str, list[dict]] = {}
    for name, record in records.items():
        by_object.setdefault(name.rpartition(" ")[0], []).append(record)
    num_runs = max(map(len, by_object.values()))
    heads = [*(f"view {view}" for view in protocol.reported_views), "all views", f"{methods[0]} ahead"]
    lines = [f"{len(by_object)} objects, {num_runs} runs each; percent covered, 90 % intervals over objects"]
    lines.append(f"{'':16}" + "".join(f"{head:>21}" for head in heads) + f"{'seconds a view':>16}")
    curves = {
        method: np.array([np.mean([run[method]["covered"] for run in runs], axis=0) for runs in by_object.values()])
        for method in methods
    }
    for method, curve in curves.items():
        lead = curves[methods[0]].mean(axis=1) - curve.mean(axis=1)
        columns = np.column_stack([*(curve[:, view - 1] for view in protocol.reported_views), curve.mean(axis=1), lead])
        low, high = interval(columns)
        cells = zip(100 * columns.mean(axis=0), 100 * low, 100 * high, strict=True)
        seconds = [run[method]["seconds"] for runs in by_object.values() for run in runs]
        second = f"{np.mean(seconds):16.2f}" if seconds[0] is not None else ""
        lines.append(f"{method:16}" + "".join(f"{a:7.1f} [{b:5.1f},{c:5.1f}]" for a, b, c in cells) + second)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("protocol", choices=PROTOCOLS)
    parser.add_argument("--mesh", nargs="+", type=Path, required=True, help="mesh files")
    parser.add_argument("--up", default="y", help="the files' axis that is upward")
    parser.add_argument("--half", action="store_true", help="candidates on the upper half alone")
    parser.add_argument("--rays", type=int, default=40, help="rays along a side of the images that are imagined")
    parser.add_argument("--stride", type=int, help="rows and columns of the sensor's image for one that counts")
    parser.add_argument("--repeats", type=int, help="runs of each object; default: the protocol's")
    parser.add_argument("--out", type=Path, help="default: runs/peers-PROTOCOL[-half].json")
    options = parser.parse_args()
    protocol, methods = PROTOCOLS[options.protocol], METHODS[options.protocol]
    repeats = options.repeats or protocol.repeats
    protocol = protocol._replace(stride=options.stride or protocol.stride)
    out = options.out or Path("runs") / f"peers-{options.protocol}{'-half' if options.half else ''}.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    settings = {name: getattr(options, name) for name in ("protocol", "half", "up", "rays")} | {
        "stride": protocol.stride
    }
    results = json.loads(out.read_text()) if out.exists() else {"settings": settings, "runs": {}}
    if results.get("settings") != settings:
        parser.error(f"{out} holds runs of {results.get('settings')}, asked for are {settings}: give another --out")
    records = results["runs"]
    for file in tqdm(options.mesh, desc="objects"):
        names = [f"{file.parent.name}/{file.stem} {repeat}" for repeat in range(repeats)]
        if all(name in records for name in names):
            continue
        trial = Trial(file, protocol, options.half, options.up)
        if trial.mesh.bounding_radius * trial.unit > protocol.distance / 1.5:
            tqdm.write(f"left out {file.stem}: the cameras would stand in or beside it")
            continue
        for repeat, name in enumerate(names):
            if name not in records:
                records[name] = run(trial, methods, options.rays, repeat)
                write_text(out, json.dumps(results))
    print(table(records, methods, protocol))


if __name__ == "__main__":
    main()
