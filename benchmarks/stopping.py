"""Views that a stop rule saves, and its effect on the answers.

    python benchmarks/stopping.py [--task class parts coverage] [--scenes 24] [--out FILE]

Scans each object of the test split to the end once, then evaluates every rule after each view. `class`: pyramids,
whole, by cross-entropy, 6 views; right if the likeliest class is the true one. `parts`: objects of thirteen categories
by soft part count, 6 views; right if every part of the object has 60 points. `coverage`: the same objects by coverage,
14 views; right is the share truly seen, out of what the camera would see from all candidates. Intervals are of 90 %, by
resampling the scenes. Continues after the last scene in the file.
"""

import argparse
import dataclasses
import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.networks import part_segmenter, pretrained_classifier
from jaxnbv.networks.categories import CATEGORIES
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import view_keys
from jaxnbv.planning.part_rules import PartsFound
from jaxnbv.planning.stopping import Covered, StopContext, Sure
from jaxnbv.scanning import GridSurface
from jaxnbv.scanning.visibility import is_visible, spread_points
from jaxnbv.storage.files import write_text
from jaxnbv.studies.engine.results import interval
from jaxnbv.studies.scenes import Framing, Split, hidden_view, part_scene, pyramid_scene

SIDE = Framing.WHOLE.longest_side
FIRST = nbv.look_at((0.8, 0.9, 2.2))
RULES = {
    "class": {
        f"{'Sure' if again else 'D alone'} {p}": Sure(p, again) for again in (8, 0) for p in (0.8, 0.9, 0.95, 0.99)
    },
    "parts": {f"PartsFound {points}": PartsFound(points) for points in (20, 40, 60, 100)},
    "coverage": {f"Covered {share}": Covered(share) for share in (0.6, 0.7, 0.8, 0.9)},
}
VIEWS = {"class": 6, "parts": 6, "coverage": 14}


def planner_of(acquisition: nbv.Acquisition, radius: float, side: float = 2.5, solid: bool = False) -> nbv.Planner:
    sampler = nbv.SurfaceSampler.preset("screened", side, solid=solid)
    sampler = dataclasses.replace(sampler, grid=nbv.Grid(64, 0.7 * side), num_samples=8)
    search = nbv.DiscreteSearch(nbv.SphereCandidates(48, radius))
    return nbv.Planner(acquisition, search, sampler=sampler, capacity=4096)


@functools.cache
def planner_for(task: str, category: str) -> nbv.Planner:
    """A planner for all objects of a category, so that nothing is compiled twice."""
    if task == "class":
        return planner_of(nbv.CrossEntropy(pretrained_classifier("pyramid", SIDE)), 2.5, SIDE, solid=True)
    if task == "coverage":
        return planner_of(nbv.NewSurface(), 2.5)
    utility = nbv.SoftPartCount(part_segmenter(category))
    return planner_of(nbv.ExpectedUtilityImprovement(utility, num_points=1024), 2.0)


def measure(task: str, index: int) -> dict:
    """The view after which each rule stops, and the correctness after every view."""
    key = jax.random.fold_in(jax.random.key(15), index)
    if task == "class":
        pyramid = pyramid_scene(Split.TEST, index, Framing.WHOLE)
        surface, first, category = nbv.SDFSurface(pyramid), hidden_view(pyramid, key), ""
    else:
        part_object = part_scene(Split.TEST, index)
        surface, first, category = nbv.SDFSurface(part_object.solid), FIRST, CATEGORIES[int(part_object.category)].name
    planner = planner_for(task, category)
    episode = nbv.simulate(planner, surface, first, VIEWS[task], key, progress=False)
    if task == "coverage":
        is_shown, areas = truly_shown(part_object.solid, planner, episode)
    right, ends = [], {name: VIEWS[task] for name in RULES[task]}
    for count, observations in enumerate(episode.observations(), start=1):
        if task == "class":
            values = planner.acquisition.answer(observations.cloud).values
            right.append(float(int(np.argmax(values)) == int(pyramid.label)))
        elif task == "parts":
            counts = planner.acquisition.answer(observations.cloud).values
            right.append(float((counts[np.asarray(part_object.parts)] >= 60).all()))
        else:
            right.append(float(areas[is_shown[:count].any(axis=0)].sum() / areas.sum()))
        poses = tuple(view.pose for view in episode.views[:count])
        sample_key, *_ = view_keys(key, count)
        surfaces = functools.cache(functools.partial(planner.sampler.sample, observations, sample_key))
        context = StopContext(planner, observations, poses, 0.0, sample_key, surfaces, nbv.Frame())
        for name, rule in RULES[task].items():
            if ends[name] == VIEWS[task] and rule.after(context) is not None:
                ends[name] = count
    return {"right": right, "ends": ends}


def truly_shown(solid, planner: nbv.Planner, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Whether each view shows each point of the true surface that a candidate shows, and the areas of the points."""
    grid = planner.sampler.grid
    nodes = np.stack(np.meshgrid(*3 * [grid.axis], indexing="ij"), axis=-1).reshape(-1, 3)
    values = jax.lax.map(solid, jnp.asarray(nodes, jnp.float32), batch_size=65_536)
    surface = GridSurface.from_values(values.reshape(3 * (grid.resolution,)), 0.0, grid)
    points = spread_points(surface, 20_000)
    poses = jax.tree.map(lambda *rows: jnp.stack(rows), *(view.pose for view in episode.views))
    views, candidates = (
        np.asarray(is_visible(surface, planner.camera, view_poses, points, grid.spacing))
        for view_poses in (poses, planner.search.poses_around())
    )
    is_visible_from_any = candidates.any(axis=0)
    return views & is_visible_from_any, np.asarray(points.areas)[is_visible_from_any]


def table(task: str, records: list[dict]) -> str:
    views = VIEWS[task]

    def format_interval(values) -> str:
        (low,), (high,) = interval(np.asarray(values, float)[:, None])
        return f"{np.mean(values):5.2f} [{low:5.2f}, {high:5.2f}]"

    right_at_end = [record["right"][-1] for record in records]
    lines = [
        f"{task}: {len(records)} scenes, {views} views",
        f"{'rule':<14} views                 right then          right then less in the end",
    ]
    lines.append(f"{'none':<14} {format_interval([views] * len(records))}  {format_interval(right_at_end)}")
    for name in RULES[task]:
        ends = [record["ends"][name] for record in records]
        right_at_stop = [record["right"][end - 1] for record, end in zip(records, ends, strict=True)]
        differences = [a - b for a, b in zip(right_at_stop, right_at_end, strict=True)]
        lines.append(f"{name:<14} {'  '.join(map(format_interval, (ends, right_at_stop, differences)))}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", choices=RULES, default=list(RULES))
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--out", type=Path, default=Path("runs/stopping.json"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    for task in options.task:
        records = results.setdefault(task, [])
        for index in tqdm(range(len(records), options.scenes), desc=task):
            records.append(measure(task, index))
            write_text(options.out, json.dumps(results))
        print(table(task, records[: options.scenes]))


if __name__ == "__main__":
    main()
