"""Time the stages of one planning step at the paper's settings, on this machine, against a yardstick and a rival.

    python benchmarks/step.py [--mesh FILE] [--model screened|paper] [--out results.json]

The settings: S = 16 samples, 120 candidates, 50 x 50 rays, grid 100^3, capacity 8,192, and the default surfaces, or the
paper's with L = 50; the whole step is also timed with the paper's. Every stage is timed
after compilation as the least of several runs; the first whole step is also timed with compilation. The yardstick is a
2,000^3 float32 matrix product; the rival of the scan is marching cubes (scikit-image) and Embree (through trimesh) on
the same samples, meshes and trees included.
"""

import argparse
import json
import resource
import sys
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from skimage.measure import marching_cubes
from timing import least_time

import jaxnbv as nbv
from jaxnbv.imagination import MODELS
from jaxnbv.planning.episode import observe_scene
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage import describe
from jaxnbv.storage.folders import versions
from jaxnbv.studies.scenes import demo_object

FIGURES = {
    "samples": ("prior and posterior samples of f on the grid", 6.0),
    "samples, full": ("the same at 8,192 points", 15.0),
    "scan": ("scan of 16 samples from 120 candidates", 1.5),
    "coverage": ("coverage values of the 1,920 scans", 2.5),
    "step": ("one whole step", 10.0),
    "first step": ("first step, compilation included", 60.0),
}
PEAK_MEMORY = 6.0


def rival_scan(surfaces: nbv.GridSurface, origins: np.ndarray, directions: np.ndarray) -> float:
    """Seconds that marching cubes and Embree take for the same scans."""
    values, spacing = np.array(surfaces.values), surfaces.grid.spacing
    start = time.perf_counter()
    for field in values:
        vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(spacing,) * 3)
        mesh = trimesh.Trimesh(vertices - surfaces.grid.half_extent, faces, process=False)
        mesh.ray.intersects_id(origins, directions, multiple_hits=False, return_locations=True)
    return time.perf_counter() - start


def full_cloud(planner: nbv.Planner, scene: nbv.Surface) -> nbv.Evidence:
    """A evidence whose cloud is full: as many views from around the object as that takes."""
    evidence = None
    for index, position in enumerate(nbv.fibonacci_sphere(planner.max_views, 2.5)):
        pose = nbv.look_at(position)
        seen = observe_scene(scene, planner.camera, pose, nbv.SensorNoise(), jax.random.key(index))
        evidence = planner.init(pose, seen) if evidence is None else planner.observe(evidence, pose, seen)
        if int(evidence.cloud.count) == planner.capacity:
            break
    return evidence


def planner_of(name: str) -> nbv.Planner:
    """The planner of expected coverage with the surfaces of a name."""
    return nbv.Planner(nbv.Coverage(), imagination=nbv.Imagination.preset(name))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mesh", help="a mesh file; the demo object if left out")
    parser.add_argument("--model", choices=MODELS, default=MODELS[0], help="by what surfaces are imagined")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/step.json"))
    arguments = parser.parse_args()

    scene = nbv.load_mesh(arguments.mesh) if arguments.mesh else demo_object()
    planner, published = (planner_of(name) for name in (arguments.model, "paper"))
    first, key = nbv.look_at((0.8, 0.9, 2.2)), jax.random.key(0)
    seen = observe_scene(scene, planner.camera, first, nbv.SensorNoise(), key)
    evidence = planner.init(first, seen)

    start = time.perf_counter()
    jax.block_until_ready(planner.propose(evidence, key))
    seconds = {"first step": time.perf_counter() - start}

    seconds["samples"] = least_time(lambda: planner.imagination.sample(evidence, key))
    surfaces = planner.imagination.sample(evidence, key)
    poses = sphere_candidates(120, 2.5)

    @jax.jit
    def seen_points(surfaces):
        scans = nbv.scan_samples(surfaces, planner.camera, poses)
        return scans.points, scans.mask

    seconds["scan"] = least_time(lambda: seen_points(surfaces))
    scans = nbv.scan_samples(surfaces, planner.camera, poses)

    @jax.jit
    def values(cloud, scans):
        context = planner.acquisition.context(cloud)
        score = partial(nbv.acquisition.scores, planner.acquisition, context, camera=planner.camera, poses=poses)
        return jnp.mean(jax.lax.map(score, scans), axis=0)

    # The stages as they are timed must be the stages of the step.
    acquisition = nbv.expected_value(planner.acquisition, evidence.cloud, surfaces, planner.camera, poses)
    assert bool(jnp.allclose(values(evidence.cloud, scans), acquisition, rtol=1e-3))
    seconds["coverage"] = least_time(lambda: values(evidence.cloud, scans))
    seconds["step"] = least_time(lambda: planner.propose(evidence, key))
    published_evidence = published.init(first, seen)
    seconds["published"] = least_time(lambda: published.propose(published_evidence, key))
    full = full_cloud(planner, scene)
    seconds["samples, full"] = least_time(lambda: planner.imagination.sample(full, key))
    seconds["coverage, full"] = least_time(lambda: values(full.cloud, scans))
    matrix = jax.random.normal(key, (2000, 2000))
    product = jax.jit(lambda a: a @ a)
    seconds["yardstick"] = least_time(lambda: product(matrix), repeats=10)
    origins, directions = (np.asarray(rays).reshape(-1, 3) for rays in planner.camera.rays(poses))
    seconds["rival"] = min(rival_scan(surfaces, origins, directions) for _ in range(2))
    # Linux gives kilobytes, macOS bytes.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)

    print(f"{jax.devices()[0].device_kind}; {int(evidence.cloud.count)} points, then {int(full.cloud.count)}")
    print(f"{'stage':48s} {'seconds':>8s} {'at most':>8s} {'of step':>8s} {'yardsticks':>10s}")
    for name, (text, limit) in FIGURES.items():
        share, yardsticks = seconds[name] / seconds["step"], seconds[name] / seconds["yardstick"]
        missed = f"  {seconds[name] / limit:.2f} x the limit" if seconds[name] > limit else ""
        print(f"{text:48s} {seconds[name]:8.2f} {limit:8.1f} {share:8.0%} {yardsticks:10.0f}{missed}")
    print(f"{'one whole step with the published surfaces':48s} {seconds['published']:8.2f}", end="")
    print(f"  the step takes {seconds['step'] / seconds['published']:.2f} x that")
    print(f"{'coverage values at 8,192 points':48s} {seconds['coverage, full']:8.2f}")
    print(f"{'marching cubes and Embree, the same scans':48s} {seconds['rival']:8.2f}", end="")
    print(f"  the scan takes {seconds['scan'] / seconds['rival']:.2f} x that")
    print(f"{'yardstick: 2,000^3 float32 product':48s} {seconds['yardstick']:8.3f}")
    print(f"{'peak memory, GB':48s} {peak:8.2f} {PEAK_MEMORY:8.1f}")
    record = {
        "planner": describe(planner),
        "points": [int(evidence.cloud.count), int(full.cloud.count)],
        "versions": versions(),
        "seconds": seconds,
        "share_of_step": {name: value / seconds["step"] for name, value in seconds.items()},
        "at_most": {name: limit for name, (_, limit) in FIGURES.items()},
        "peak_memory_gb": peak,
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
