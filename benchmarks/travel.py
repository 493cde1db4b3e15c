"""Coverage against the number of views and the length of the camera's path, with and without a cost of travel.

    python benchmarks/travel.py --mesh FILE ... [--views 8] [--out FILE]

Each mesh is scanned from one random first view by coverage over 60 candidates on a sphere: by value, by value per cost
(fixed + length of the path, in scene units), and by farthest view. All methods see the same noise and the same samples
at the same view. Coverage is the share of the true surface within 0.05 of the cloud. Continues after the last mesh in
the file.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.planning.loop import view_keys
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.planning.travel import arc_length, total_cost
from jaxnbv.scanning.metrics import coverage, truth_points
from jaxnbv.storage.files import write_text
from jaxnbv.studies.engine.results import interval

CANDIDATES = nbv.SphereCandidates(60)
# Search and cost.
METHODS = {
    "value": (nbv.DiscreteSearch(CANDIDATES), None),
    "value per cost, fixed 2": (nbv.DiscreteSearch(CANDIDATES), nbv.ValuePerCost(arc_length, fixed=2.0)),
    "value per cost, fixed 0.5": (nbv.DiscreteSearch(CANDIDATES), nbv.ValuePerCost(arc_length, fixed=0.5)),
    "farthest view": (nbv.FarthestView(CANDIDATES), None),
}


def episode(planner: nbv.Planner, mesh: nbv.TriangleMesh, truth: np.ndarray, views: int, key) -> dict:
    """Coverage and length of the path after each view."""
    direction = jax.random.normal(jax.random.fold_in(key, 99), (3,))
    pose = nbv.look_at(2.5 * direction / jnp.linalg.norm(direction))
    observations, poses, scans, measures = None, [], [], {"way": []}
    for index in range(views):
        if observations is not None:
            pose = planner.propose(observations, view_keys(key, index)[0]).pose
        cloud = observe_scene(mesh, planner.camera, pose, nbv.SensorNoise(), view_keys(key, index)[2])
        observations = planner.init(pose, cloud) if observations is None else planner.observe(observations, pose, cloud)
        poses.append(pose)
        scans.append(nbv.View(pose, cloud, observations.cloud, None, planner.camera))
        measures["way"].append(total_cost(poses))
    measures["coverage"] = coverage(scans, truth)
    return measures


def summary(records: dict, views: int) -> str:
    names = list(METHODS)

    def format_interval(values) -> str:
        (low,), (high,) = interval(np.asarray(values, float)[:, None])
        return f"{np.mean(values):6.3f} [{low:6.3f}, {high:6.3f}]"

    lines = [f"{len(records)} meshes, means and 90 % intervals over them"]
    for count in range(4, views + 1, 2):
        lines.append(f"after {count} views: coverage, way (scene units); coverage by the value's way; less the value's")
        path_lengths = {m: [r["value"]["way"][count - 1] for r in records.values()] for m in ["value"]}["value"]
        for name in names:
            runs = [record[name] for record in records.values()]
            coverages = [run["coverage"][count - 1] for run in runs]
            coverages_at_length = [
                float(np.interp(length, run["way"], run["coverage"]))
                for length, run in zip(path_lengths, runs, strict=True)
            ]
            base = [record["value"]["coverage"][count - 1] for record in records.values()]
            differences = [a - b for a, b in zip(coverages, base, strict=True)]
            lengths = [run["way"][count - 1] for run in runs]
            columns = coverages, lengths, coverages_at_length, differences
            lines.append(f"  {name:<26} {'  '.join(map(format_interval, columns))}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", nargs="+", type=Path, required=True)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("runs/travel.json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    records = json.loads(options.out.read_text()) if options.out.exists() else {}
    for file in tqdm(options.mesh, desc="meshes"):
        if file.stem in records:
            continue
        mesh = nbv.load_mesh(file)
        truth = truth_points(mesh, jax.random.key(0))
        results = {}
        for name, (search, cost) in METHODS.items():
            sampler = nbv.SurfaceSampler(grid=nbv.Grid(64), num_samples=8)
            planner = nbv.Planner(nbv.Coverage(), search, sampler=sampler, cost=cost, capacity=4096)
            key = jax.random.fold_in(jax.random.key(4), sum(map(ord, file.stem)))
            results[name] = episode(planner, mesh, truth, options.views, key)
        records[file.stem] = results
        write_text(options.out, json.dumps(records))
    print(summary(records, options.views))


if __name__ == "__main__":
    main()
