"""Time of a step against the numbers of points, samples, candidates and rays, as JSON and a figure.

    python benchmarks/scaling.py [--out runs/scaling]

Changes one of the four at a time. The others stay at 2,000 points, 16 samples, 120 candidates and 50 x 50 rays, for new
surface by the full search after two views of a mug. Times are the least of three, without compilation, for the samples
(posterior, values on the grid) and for the search. Continues after the last time in the file, so give another file for
another machine.
"""

import argparse
import dataclasses
import functools
import json
from pathlib import Path

import jax
import matplotlib.pyplot as plt
from timing import least_time

import jaxnbv as nbv
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.storage.files import write_text
from jaxnbv.studies.scenes import demo_object

DEFAULT_SIZES = {"points": 2000, "samples": 16, "candidates": 120, "rays": 50**2}
SIZES = {
    "points": (500, 1000, 2000, 4000, 8000),
    "samples": (4, 8, 16, 32, 64),
    "candidates": (30, 60, 120, 240, 480),
    "rays": tuple(side**2 for side in (12, 25, 50, 100)),
}
STAGES = {"samples": "posterior and samples", "search": "search"}


@functools.cache
def measure(points: int, samples: int, candidates: int, rays: int) -> dict[str, float]:
    """Seconds of each stage at these sizes."""
    side, key = round(rays**0.5), jax.random.key(0)
    sampler = dataclasses.replace(nbv.SurfaceSampler(), num_samples=samples)
    camera, search = nbv.Camera(height=side, width=side), nbv.DiscreteSearch(candidates)
    planner = nbv.Planner(nbv.NewSurface(), search, camera, sampler, capacity=points)
    # The sensor has more rays than imagined scans, so that D is full at any size.
    sensor, scene, observations = nbv.Camera(height=150, width=150), demo_object(), None
    for position in ((0.8, 0.9, 2.2), (-1.4, 0.6, -1.9)):
        pose = nbv.look_at(position)
        cloud = observe_scene(scene, sensor, pose, nbv.SensorNoise(), key)
        observations = (
            planner.observe(observations, pose, cloud, sensor) if observations else planner.init(pose, cloud, sensor)
        )
    assert int(observations.cloud.count) == points
    inputs = planner.step_inputs(observations, key)
    return {
        "samples": least_time(lambda: planner.step_inputs(observations, key)),
        "search": least_time(lambda: planner.choose(inputs, key)),
    }


def figure(times: dict[str, dict[str, dict[str, float]]], path: Path) -> None:
    """Draw a panel for each of the four, with logarithmic axes."""
    chart, panels = plt.subplots(1, len(SIZES), figsize=(11, 2.7), sharey=True, layout="constrained")
    for panel, (name, sizes) in zip(panels, SIZES.items(), strict=True):
        for stage, label in STAGES.items():
            panel.loglog(sizes, [times[name][str(size)][stage] for size in sizes], "o-", label=label)
        panel.set(xlabel=name, xticks=sizes, xticklabels=[f"{size:,}" for size in sizes])
        panel.minorticks_off()
        panel.axvline(DEFAULT_SIZES[name], color="0.8", zorder=0)
        panel.spines[["top", "right"]].set_visible(False)
    seconds = (0.02, 0.1, 0.5, 1, 2, 5, 10, 50)
    panels[0].set(ylabel="seconds", yticks=seconds, yticklabels=seconds, ylim=panels[0].get_ylim())
    panels[0].legend(frameon=False)
    chart.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/scaling"))
    out = parser.parse_args().out
    out.parent.mkdir(parents=True, exist_ok=True)
    file = out.with_suffix(".json")
    times = json.loads(file.read_text()) if file.exists() else {}
    for name, sizes in SIZES.items():
        for size in sizes:
            if str(size) not in times.setdefault(name, {}):
                times[name][str(size)] = measure(**DEFAULT_SIZES | {name: size})
                print(f"{size:,} {name}: {times[name][str(size)]}", flush=True)
                write_text(file, json.dumps(times))
    figure(times, out.with_suffix(".png"))


if __name__ == "__main__":
    main()
