"""Time the heat utility on this machine: its stages for one cloud, and the candidates of one sample over all cores.

    python benchmarks/heat.py [--out results.json]

The clouds are random points of a torus, with the sensor's noise, at the paper's T = 5 and 20 steps. A step of the paper
values 100 candidates for each of 16 samples.
"""

import argparse
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from loky import cpu_count
from timing import least_time

import jaxnbv as nbv
from jaxnbv.storage.folders import versions
from jaxnbv.tasks.diffusion import HeatProblem, cloud_laplacian, cloud_temperature, diffuse
from jaxnbv.tasks.heat import ColdestPoint

SIZES = (2000, 4000, 6000)
CANDIDATES = 100


def torus(count: int, seed: int = 0) -> np.ndarray:
    """Noisy points of a torus that fills the scene."""
    points, _ = trimesh.sample.sample_surface(trimesh.creation.torus(0.95, 0.3, 96, 48), count, seed=seed)
    return np.asarray(points) + 0.01 * np.random.default_rng(seed).normal(size=(count, 3))


def stages(count: int) -> dict[str, float]:
    """Seconds for one cloud."""
    points = torus(count)
    heat = HeatProblem(points[0])
    laplacian, start = cloud_laplacian(points), np.zeros(count)
    heating = heat.heating(points, laplacian.mass)
    solve = lambda steps: diffuse(laplacian, start, heating, heat.duration, steps)  # noqa: E731
    one = least_time(lambda: solve(1))
    every = least_time(lambda: solve(heat.steps))
    return {
        "laplacian": least_time(lambda: cloud_laplacian(points)),
        "factorisation and a step": one,
        "the other steps": every - one,
        "whole": least_time(lambda: cloud_temperature(points, heat).coldest(reached_only=False)),
    }


def batch(count: int, workers: int) -> float:
    """Seconds for all candidates of one sample."""
    points = np.stack([torus(count, seed) for seed in range(CANDIDATES)])
    clouds = nbv.PointCloud(jnp.asarray(points), jnp.zeros_like(jnp.asarray(points)), jnp.ones(points.shape[:2], bool))
    utility = ColdestPoint(points[0, 0], workers=workers)
    values = eqx.filter_jit(eqx.filter_vmap(utility))
    return least_time(lambda: values(clouds), repeats=1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/heat.json"))
    arguments = parser.parse_args()
    record = {"device": jax.devices()[0].device_kind, "cores": cpu_count(), "versions": versions()}
    record["one cloud"] = {count: stages(count) for count in SIZES}
    record["candidates"] = {workers: batch(SIZES[1], workers) for workers in sorted({1, cpu_count()})}
    for count, seconds in record["one cloud"].items():
        print(f"{count} points: " + ", ".join(f"{name} {1e3 * value:.0f} ms" for name, value in seconds.items()))
    for workers, seconds in record["candidates"].items():
        print(f"{CANDIDATES} clouds of {SIZES[1]} points, {workers} workers: {seconds:.1f} s")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
