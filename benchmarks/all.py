"""Time every stage of planning on this machine, as ratios to a yardstick, to other programs, and to the arithmetic.

    python benchmarks/all.py [--mesh FILE] [--only STAGE ...] [--out runs/all]
    JAX_NUM_CPU_DEVICES=2 python benchmarks/all.py --only devices episodes

Settings are the paper's: 16 samples on a 100^3 grid, 120 candidates, 50 x 50 rays, one view of a mug or of a mesh.
Times are the least of three, without compilation. Times with compilation are called "first". The yardstick is a 2,000^3
float32 product. A scan is compared with marching cubes (scikit-image) and Embree (through trimesh) on the same samples,
including the time for meshes and trees. The least time of a network is its multiply-adds at the yardstick's rate. A
step is shared among all devices. Writes OUT.json and OUT.md.
"""

import argparse
import json
import resource
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from skimage.measure import marching_cubes
from timing import least_time

import jaxnbv as nbv
from jaxnbv.acquisition import inputs_of, scores
from jaxnbv.networks import pretrained_classifier
from jaxnbv.planning.session_scene import usual_planner
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.scanning.grid import samples_at_once
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage.folders import versions
from jaxnbv.studies.scenes import Framing, Split, demo_object, hidden_view, pyramid_scene

_NUM_PARTS = 200


class Bench:
    """Inputs that all stages share, and the results: seconds by stage, with ratios."""

    def __init__(self, mesh: str | None):
        self.key, self.first = jax.random.key(0), nbv.look_at((0.8, 0.9, 2.2))
        self.candidates = sphere_candidates(120, 2.5)
        self.scene = nbv.load_mesh(mesh) if mesh else demo_object()
        self.rows: dict[str, dict[str, float]] = {}

    def take(self, stage: str, function, **comparisons: float) -> float:
        """Time a function and record it. `comparisons`: seconds of what it is compared to, by name."""
        return self.note(stage, least_time(function), **comparisons)

    def note(self, stage: str, seconds: float, **comparisons: float) -> float:
        self.rows[stage] = {"seconds": seconds} | {name: seconds / other for name, other in comparisons.items()}
        print(f"{stage}: {seconds:.3g} s; {peak_memory():.1f} GB at most so far", flush=True)
        return seconds

    def observations(self, planner: nbv.Planner, views: int = 1) -> nbv.Observations:
        """Observations after the first view and `views - 1` others around the object."""
        observations, around = None, map(nbv.look_at, nbv.geometry.fibonacci_sphere(views, 2.5))
        for index, pose in enumerate([self.first, *around][:views]):
            cloud = observe_scene(self.scene, planner.camera, pose, nbv.SensorNoise(), jax.random.key(index))
            observations = planner.observe(observations, pose, cloud) if observations else planner.init(pose, cloud)
        return observations


def rival_scan(surfaces: nbv.scanning.GridSurface, camera: nbv.Camera, poses: nbv.Pose) -> float:
    """Seconds that marching cubes and Embree take to scan all samples from all poses."""
    values, spacing = np.array(surfaces.values), surfaces.grid.spacing
    origins, directions = (np.asarray(rays).reshape(-1, 3) for rays in camera.rays(poses))
    start = time.perf_counter()
    for field in values:
        vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(spacing,) * 3)
        mesh = trimesh.Trimesh(vertices - surfaces.grid.half_extent, faces, process=False)
        mesh.ray.intersects_id(origins, directions, multiple_hits=False, return_locations=True)
    return time.perf_counter() - start


def coverage(bench: Bench) -> None:
    """The paper's acquisition by the full search, after one view and with a full cloud of 8,192 points."""
    planner = nbv.Planner(nbv.Coverage())
    observations = bench.observations(planner)
    start = time.perf_counter()
    jax.block_until_ready(planner.propose(observations, bench.key))
    bench.note("coverage: first step, compilation included", time.perf_counter() - start)
    step = bench.take("coverage: a step", lambda: planner.propose(observations, bench.key))
    bench.take("coverage: samples on the grid", lambda: planner.sampler.sample(observations, bench.key), step=step)
    surfaces = planner.sampler.sample(observations, bench.key)
    rival = min(rival_scan(surfaces, planner.camera, bench.candidates) for _ in range(2))
    bench.note("the same scans by marching cubes and Embree", rival)
    # Coverage reads no normals, and its step computes none.
    points = jax.jit(lambda surfaces: nbv.scanning.scan_samples(surfaces, planner.camera, bench.candidates).points)
    bench.take("coverage: 16 samples scanned from 120 candidates", lambda: points(surfaces), step=step, rival=rival)
    scans = nbv.scanning.scan_samples(surfaces, planner.camera, bench.candidates)

    @jax.jit
    def values(cloud, scans):
        context = planner.acquisition.context(inputs_of(cloud))
        score = lambda scan: scores(planner.acquisition, context, scan, planner.camera, bench.candidates)  # noqa: E731
        return jnp.mean(jax.lax.map(score, scans, batch_size=samples_at_once(planner.camera, bench.candidates)), axis=0)

    # The parts that are timed must give the values of a real step.
    expected = nbv.expected_value(planner.acquisition, observations.cloud, surfaces, planner.camera, bench.candidates)
    np.testing.assert_allclose(values(observations.cloud, scans), expected, rtol=1e-3)
    bench.take("coverage: values of the 1,920 scans", lambda: values(observations.cloud, scans), step=step)
    full = bench.observations(planner, 13)
    bench.take(
        f"coverage: a step at {int(full.cloud.count):,} points", lambda: planner.propose(full, bench.key), step=step
    )


def sessions(bench: Bench) -> None:
    """New surface, the acquisition of sessions."""
    planner = usual_planner()
    second = bench.observations(planner, 2)
    step = bench.take("new surface, as sessions plan: the second step", lambda: planner.propose(second, bench.key))
    tenth = bench.observations(planner, 10)
    bench.take("new surface, as sessions plan: the tenth", lambda: planner.propose(tenth, bench.key), second=step)


def cross_entropy(bench: Bench) -> None:
    """The shipped classifier of pyramids on 1,920 clouds of 1,024 points, by the full search and by halving."""
    pyramid = pyramid_scene(Split.TEST, 0, Framing.CLOSE_UP)
    classifier = pretrained_classifier("pyramid", Framing.CLOSE_UP.longest_side)
    sampler = nbv.SurfaceSampler.preset("paper")
    planner = nbv.Planner(nbv.CrossEntropy(classifier), sampler=sampler)
    first = hidden_view(pyramid, bench.key)
    cloud = observe_scene(nbv.SDFSurface(pyramid), planner.camera, first, nbv.SensorNoise(), bench.key)
    observations = planner.init(first, cloud)
    step = bench.take("cross-entropy: a step", lambda: planner.propose(observations, bench.key))
    halving = nbv.Planner(planner.acquisition, nbv.HalvingSearch(), sampler=sampler)
    bench.take("cross-entropy: a step by halving", lambda: halving.propose(observations, bench.key), step=step)
    bench.take("cross-entropy: samples on the grid", lambda: planner.sampler.sample(observations, bench.key), step=step)
    surfaces = planner.sampler.sample(observations, bench.key)
    scans = lambda: nbv.scanning.scan_samples(surfaces, planner.camera, bench.candidates)  # noqa: E731
    bench.take("cross-entropy: 16 samples scanned from 120 candidates", scans, step=step)
    scan_rows = jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), scans())
    context_cloud = planner.acquisition.context(inputs_of(observations))[0]

    @jax.jit
    def subsample_all(scan_rows):
        def join(scan):
            return nbv.geometry.farthest_point_subsample(
                nbv.geometry.concatenate(context_cloud, scan), classifier.num_points
            )

        return jax.lax.map(join, scan_rows)

    bench.take("cross-entropy: farthest points of 1,920 clouds", lambda: subsample_all(scan_rows), step=step)
    clouds = subsample_all(scan_rows)
    network = jax.jit(lambda clouds: jax.lax.map(lambda c: classifier.network(c.points, c.normals, c.mask), clouds))
    bench.take("cross-entropy: the network on 1,920 clouds", lambda: network(clouds), step=step)


def gradient(bench: Bench) -> None:
    """Searches on the same samples, as ratios to discrete search."""
    planner = nbv.Planner(nbv.Coverage())
    observations = bench.observations(planner)
    inputs = planner.step_inputs(observations, bench.key)
    discrete = bench.take("search: discrete, 120 candidates", lambda: planner.choose(inputs, bench.key))
    searches = {
        "halving, 120 candidates": nbv.HalvingSearch(),
        "gradient, six starts": nbv.GradientSearch(dof=2, num_candidates=6),
        "gradient, 100 candidates": nbv.GradientSearch(dof=2),
        "hybrid": nbv.search.HybridSearch(),
    }
    for name, search in searches.items():
        other = nbv.Planner(planner.acquisition, search)
        bench.take(f"search: {name}", lambda other=other: other.choose(inputs, bench.key), discrete=discrete)


def parts(bench: Bench) -> None:
    """Identification among 200 parts at true size, cuboids whose sides are random."""
    sides = np.random.default_rng(0).uniform(0.4, 1.6, (_NUM_PARTS, 3))
    bank = nbv.ShapeBank.from_meshes([trimesh.creation.box(extents=row) for row in sides], scale=1.0, progress=False)
    planner, part = nbv.Planner.for_parts(bank), nbv.SDFSurface(nbv.sdf.Cuboid(0.5 * sides[0]))
    cloud = observe_scene(part, planner.camera, bench.first, nbv.SensorNoise(), bench.key)
    name = f"identification: a view is registered to {_NUM_PARTS} parts"
    registration = bench.take(name, lambda: planner.init(bench.first, cloud))
    observations = planner.init(bench.first, cloud)
    bench.take(
        f"identification: a step with {_NUM_PARTS} parts",
        lambda: planner.propose(observations, bench.key),
        registration=registration,
    )


def networks(bench: Bench) -> None:
    """PointNet++ at its published sizes on one cloud of 1,024 points, against its multiply-adds."""
    from networks import NETWORKS, multiply_adds, random_network, timings

    rate = 2000**3 / yardstick()
    normals = jax.random.normal(bench.key, (16, 1024, 3))
    normals = normals / jnp.linalg.norm(normals, axis=-1, keepdims=True)
    for name in NETWORKS:
        network = random_network(name, bench.key)
        seconds = timings(network, normals * jnp.array([1.0, 0.7, 0.5]), normals)["one cloud"]
        bench.note(f"PointNet++ of {name}", seconds, floor=multiply_adds(network) / rate)


def devices(bench: Bench) -> None:
    """A step by the full search, on one device and on all."""
    planner, count = nbv.Planner(nbv.NewSurface(), nbv.DiscreteSearch()), len(jax.devices())
    observations = bench.observations(planner)
    step = lambda: planner.propose(observations, bench.key)  # noqa: E731
    alone = bench.take("new surface: a step on one device", step)
    if count > 1:
        with jax.set_mesh(jax.sharding.Mesh(jax.devices(), "devices")):
            bench.take(f"new surface: a step shared among {count} devices", step, alone=alone)


def episodes(bench: Bench) -> None:
    """Eight episodes of five views, in one program and by `simulate` in a loop. On a GPU also 64, against one."""
    planner, key = usual_planner(), bench.key

    def program(count: int, batch_size: int | None = None):
        keys = jax.random.split(key, count)
        return lambda: nbv.episodes(planner, count * [demo_object()], bench.first, 5, keys, batch_size=batch_size)

    def loop():
        return [
            nbv.simulate(planner, demo_object(), bench.first, 5, episode_key, progress=False) for episode_key in keys
        ]

    keys = jax.random.split(key, 8)
    one_episode = bench.note("an episode of five views as a program", least_time(program(1), repeats=1))
    loop_seconds = bench.note("eight episodes, by simulate in a loop", least_time(loop, repeats=1), one=one_episode)
    bench.note("eight episodes as a program", least_time(program(8), repeats=1), one=one_episode, loop=loop_seconds)
    if jax.default_backend() == "cpu":
        bench.note("eight episodes as a program, four at once", least_time(program(8, 4), repeats=1), loop=loop_seconds)
    else:
        bench.note("64 episodes as a program", least_time(program(64), repeats=1), one=one_episode)


def peak_memory() -> float:
    """Return the largest memory of the process so far, in GB."""
    # Linux gives KiB, macOS bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


def yardstick() -> float:
    matrix = jax.random.normal(jax.random.key(0), (2000, 2000))
    product = jax.jit(lambda a: jnp.matmul(a, a, precision="highest"))
    return least_time(lambda: product(matrix), repeats=10)


STAGES = (coverage, sessions, cross_entropy, gradient, parts, networks, devices, episodes)


def page(record: dict) -> str:
    """The table as Markdown."""
    lines = [f"{record['device']}, {record['devices']} of them; peak memory {record['peak_memory_gb']:.1f} GB.", ""]
    lines += ["| stage | seconds | yardsticks | as a ratio |", "|---|---|---|---|"]
    for stage, row in record["stages"].items():
        ratios = [f"{value:.2f} of {name}" for name, value in row.items() if name != "seconds"]
        yardsticks = row["seconds"] / record["yardstick"]
        lines.append(f"| {stage} | {row['seconds']:.3g} | {yardsticks:.3g} | {', '.join(ratios)} |")
    return "\n".join([*lines, "", f"The yardstick takes {record['yardstick']:.3f} s.", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [stage.__name__ for stage in STAGES]
    parser.add_argument("--mesh", help="a mesh file; a mug if left out")
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    parser.add_argument("--out", type=Path, default=Path("runs/all"))
    options = parser.parse_args()
    bench = Bench(options.mesh)
    for stage in STAGES:
        if stage.__name__ in options.only:
            stage(bench)
    record = {
        "device": jax.devices()[0].device_kind,
        "devices": len(jax.devices()),
        "versions": versions(),
        "yardstick": yardstick(),
        "peak_memory_gb": peak_memory(),
        "stages": bench.rows,
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.with_suffix(".json").write_text(json.dumps(record, indent=2) + "\n")
    options.out.with_suffix(".md").write_text(page(record))
    print(page(record))


if __name__ == "__main__":
    main()
