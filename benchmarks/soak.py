"""Many steps: check that memory and compilations of a planner or a session do not grow.

    python benchmarks/soak.py --steps 2000

Settings are small, so that growth is large compared with the memory of a step. A planner runs one episode of eight
views of a ball after another. A session adds one image a step to its folder, and proposes a view every tenth step. The
tables have resident memory in MiB, milliseconds a step, and programs compiled since the second view, at ten moments.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator

import jax
import numpy as np
import pandas as pd
import psutil

import jaxnbv as nbv

CAMERA, BALL = nbv.Camera(height=12, width=16), nbv.SDFSurface(nbv.sdf.Sphere(1.0))
SAMPLER = nbv.SurfaceSampler(nbv.GeometricSPSR(0.05, truncation=8), nbv.Grid(24), num_samples=2)
VIEWS = 8


def planner(max_views: int, candidates: int) -> nbv.Planner:
    search = nbv.DiscreteSearch(candidates)
    return nbv.Planner(nbv.Coverage(), search, CAMERA, SAMPLER, capacity=512, max_views=max_views)


def planning(steps: int) -> Iterator[None]:
    small_planner, first = planner(VIEWS, 20), nbv.look_at((0.0, 0.0, 2.5))
    observations = None
    for step in range(steps):
        if step % VIEWS == 0:
            observations = small_planner.init(first, nbv.scan(BALL, CAMERA, first))
        pose = small_planner.propose(observations, jax.random.key(step)).pose
        if step % VIEWS < VIEWS - 1:
            observations = small_planner.observe(observations, pose, nbv.scan(BALL, CAMERA, pose))
        yield


def session(steps: int) -> Iterator[None]:
    poses = nbv.SphereCandidates(steps, 2.5).poses()
    matrices = np.asarray(poses.to_matrix())
    with tempfile.TemporaryDirectory() as folder:
        # A session proposes no pose twice, so it needs enough candidates.
        small_planner = planner(steps, 20 + steps // 10)
        live_session = nbv.Session(
            CAMERA, ((-1.2,) * 3, (1.2,) * 3), small_planner, up="y", folder=folder, progress=False
        )
        for step in range(steps):
            pose = poses[step]
            cloud = nbv.scan(BALL, CAMERA, pose)
            depth = np.asarray((cloud.points - pose.position) @ pose.forward)
            image = np.where(cloud.mask, depth, np.inf).reshape(CAMERA.height, CAMERA.width)
            live_session.add(image, matrices[step])
            if step % 10 == 0:
                live_session.next()
            yield


def measure_steps(iterator: Iterator[None], steps: int) -> pd.DataFrame:
    """Table of memory, time and compilations at ten moments."""
    process, compile_seconds, rows = psutil.Process(), [], []

    def listen(event: str, duration: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compile_seconds.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    start, last_step, interval = time.perf_counter(), 0, max(steps // 10, 1)
    for step, _ in enumerate(iterator, start=1):
        # Everything is compiled by now. The second proposal of the session comes at its eleventh image.
        if step == 2 * VIEWS:
            compile_seconds.clear()
        if step % interval == 0:
            now = time.perf_counter()
            milliseconds = 1000.0 * (now - start) / (step - last_step)
            rows.append((step, process.memory_info().rss / 2**20, milliseconds, len(compile_seconds)))
            start, last_step = now, step
    jax.monitoring.unregister_event_duration_listener(listen)
    return pd.DataFrame(rows, columns=["steps", "MiB", "ms a step", "compiled"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000)
    steps = parser.parse_args().steps
    for name, function in {"planner": planning, "session": session}.items():
        print(
            f"\n{name}\n{measure_steps(function(steps), steps).to_string(index=False, float_format='%.0f')}", flush=True
        )


if __name__ == "__main__":
    main()
