"""Values and times of gradient searches, as ratios to discrete search over 120 candidates.

    python benchmarks/gradient.py [--task coverage|cross-entropy] [--mesh FILE] [--seeds 10] [--only NAME] [--out FILE]

Runs one step after one random view, at the paper's settings: S = 16, 50 x 50 rays, L = 50, grid 100^3. The object is a
mug (as in the demo) or a mesh for coverage, and a pyramid in close-up for cross-entropy. All searches of a seed see the
same samples. Times are without compilation. "step" includes the drawing of the samples, which all searches need. Also
prints the time of one gradient of the acquisition at six poses, divided by that of its value. Continues after the last
seed in the file if its settings are the same.
"""

import argparse
import json
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from timing import least_time
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.networks import pretrained_classifier
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage import describe
from jaxnbv.storage.folders import versions
from jaxnbv.studies.scenes import Framing, Split, demo_object, hidden_view, pyramid_scene

SEARCHES = {
    "discrete": nbv.DiscreteSearch(),
    "2-DOF": nbv.GradientSearch(dof=2),
    "2-DOF, six starts only": nbv.GradientSearch(dof=2, num_candidates=6),
    # The learning rates of the authors' published code. The paper has 0.01.
    "2-DOF, six starts, rate 5e-3": nbv.GradientSearch(dof=2, num_candidates=6, learning_rate=5e-3),
    "2-DOF, six starts, rate 1e-4": nbv.GradientSearch(dof=2, num_candidates=6, learning_rate=1e-4),
    "6-DOF": nbv.GradientSearch(dof=6),
    "6-DOF, constrained": nbv.GradientSearch(space=nbv.search.ConstrainedPoses()),
    "hybrid": nbv.search.HybridSearch(),
}
# The paper leaves cross-entropy out of free 6-DOF poses.
COVERAGE_ONLY = ("6-DOF",)


def scene_and_first(task: str, mesh: str | None, seed: int, key: jax.Array) -> tuple[nbv.scanning.Surface, nbv.Pose]:
    """The object and a random first view, which does not show the pattern of a pyramid."""
    if task == "cross-entropy":
        pyramid = pyramid_scene(Split.TEST, seed, Framing.CLOSE_UP)
        return nbv.SDFSurface(pyramid), hidden_view(pyramid, key)
    direction = jax.random.normal(key, (3,))
    first = nbv.look_at(2.5 * direction / jnp.linalg.norm(direction))
    return nbv.load_mesh(mesh) if mesh else demo_object(), first


@eqx.filter_jit
def value(planner: nbv.Planner, observations: nbv.Observations, surfaces: nbv.scanning.GridSurface, parameters):
    """The acquisition at six poses on the sphere, moved by the parameters."""
    starts = sphere_candidates(6)
    poses = jax.vmap(nbv.search.SpherePoses().retract)(starts, parameters)
    return nbv.expected_value(planner.acquisition, observations.cloud, surfaces, planner.camera, poses)


@eqx.filter_jit
def gradient(planner: nbv.Planner, observations: nbv.Observations, surfaces: nbv.scanning.GridSurface, parameters):
    """Value and gradient of the acquisition at the same poses."""
    return jax.value_and_grad(lambda moved: value(planner, observations, surfaces, moved).sum())(parameters)


def run_seed(planners: dict[str, nbv.Planner], task: str, mesh: str | None, seed: int, compiled: bool) -> dict:
    """Values and seconds of every search on one step. If nothing is compiled yet, times the second run."""
    first_key, noise_key, sample_key, search_key = jax.random.split(jax.random.key(seed), 4)
    scene, first = scene_and_first(task, mesh, seed, first_key)
    planner = planners["discrete"]
    cloud = observe_scene(scene, planner.camera, first, nbv.SensorNoise(), noise_key)
    observations = planner.init(first, cloud)
    inputs = planner.step_inputs(observations, sample_key)
    surfaces = inputs.surfaces
    parameters = jnp.zeros((6, 3))
    row = {
        "samples": least_time(lambda: planner.sampler.sample(observations, sample_key), 1),
        "six values": least_time(lambda: value(planner, observations, surfaces, parameters)),
        "six gradients": least_time(lambda: gradient(planner, observations, surfaces, parameters)),
    }
    for name, candidate_planner in planners.items():
        if not compiled:
            jax.block_until_ready(candidate_planner.choose(inputs, search_key))
        start = time.perf_counter()
        proposal = jax.block_until_ready(candidate_planner.choose(inputs, search_key))
        row[name] = {"value": float(proposal.value), "seconds": time.perf_counter() - start}
    return row


def show(rows: list[dict], names: list[str]) -> None:
    """Print medians over the seeds, and how often a search reaches the value of discrete search."""

    def column(name: str, what: str) -> np.ndarray:
        return np.array([row[name][what] for row in rows])

    samples = np.array([row["samples"] for row in rows])
    discrete, seconds = column("discrete", "value"), column("discrete", "seconds")
    print(f"{'of the discrete search':32s} {'value':>7s} {'least':>7s} {'reached':>8s} {'search':>7s} {'step':>7s}")
    for name in names:
        ratio, search_seconds = column(name, "value") / discrete, column(name, "seconds")
        reached = f"{int((ratio >= 1.0).sum())}/{len(rows)}"
        step = (samples + search_seconds) / (samples + seconds)
        print(
            f"{name:32s} {np.median(ratio):7.3f} {ratio.min():7.3f} {reached:>8s} "
            f"{np.median(search_seconds / seconds):7.2f} {np.median(step):7.2f}"
        )
    cost = np.median([row["six gradients"] / row["six values"] for row in rows])
    print(f"the discrete search takes {np.median(seconds):.2f} s, the samples {np.median(samples):.2f} s")
    print(f"one gradient at six poses takes {cost:.2f} times its value")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=["coverage", "cross-entropy"], default="coverage")
    parser.add_argument("--mesh", help="a mesh file, for coverage; the demo object if left out")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", choices=[name for name in SEARCHES if name != "discrete"], help="one search alone")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.task == "cross-entropy" and arguments.mesh:
        parser.error("cross-entropy has a classifier for pyramids only: leave --mesh out")

    acquisition = nbv.Coverage()
    if arguments.task == "cross-entropy":
        acquisition = nbv.CrossEntropy(pretrained_classifier("pyramid", Framing.CLOSE_UP.longest_side))
    names = [name for name in SEARCHES if arguments.task == "coverage" or name not in COVERAGE_ONLY]
    names = ["discrete", arguments.only] if arguments.only else names
    planners = {
        name: nbv.Planner(acquisition, SEARCHES[name], sampler=nbv.SurfaceSampler(nbv.GeometricSPSR()))
        for name in names
    }
    label = Path(arguments.mesh).stem if arguments.mesh else arguments.task
    out = arguments.out or Path("benchmarks/results") / f"gradient_{label}{'_only' if arguments.only else ''}.json"
    settings = {"object": arguments.mesh or arguments.task, "planners": describe(planners), "versions": versions()}
    settings = json.loads(json.dumps(settings))
    rows = []
    if out.exists():
        earlier = json.loads(out.read_text())
        rows = earlier["rows"] if earlier["settings"] == settings else []
    first = len(rows)
    for seed in tqdm(range(first, arguments.seeds), desc=label):
        rows.append(run_seed(planners, arguments.task, arguments.mesh, seed, compiled=seed > first))
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps({"settings": settings, "rows": rows}, indent=2) + "\n")
    print(f"{label}, {len(rows)} seeds, {jax.devices()[0].device_kind}")
    show(rows, names)


if __name__ == "__main__":
    main()
