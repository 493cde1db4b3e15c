"""What known shapes are worth by what they are of: the object's own kind, that kind without the object's class, or
another kind; and how well a shape must fit to be worth more than none.

    python benchmarks/known_shapes.py [--scenes 10] [--out FILE]

Objects are N validation household objects and N objects with parts. Views, samples and scores are those of
`benchmarks/imagination.py`. Shapes are judged beside "none of these", as the model weighs them, and alone. The last
table takes what the shapes say alone where the best misfit is below a threshold, and elsewhere the model that knows
none: its best threshold is what `unknown_misfit` should do. Continues with what the file does not hold yet.
"""

import argparse
import dataclasses
import json
import zlib
from pathlib import Path

import jax
import numpy as np
from forecasts import Truth, judge
from imagination import RAYS, VARIANTS, VOLUME, planner_of, random_views, seen_space
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage.files import write_whole
from jaxnbv.studies.scenes import PART_CATEGORIES, Split, household_scene, part_scene
from jaxnbv.studies.scenes.banks import bank_poses, shape_bank
from jaxnbv.studies.scenes.household import HOUSEHOLD
from jaxnbv.surfaces import KnownShapes
from jaxnbv.surfaces.known_shapes import kind_of

# The other kind; and what makes a scene, whose classes take turns.
OTHER = {"household": "parts", "parts": "heat"}
NONE, OWN, WITHOUT, ANOTHER = "none", "own kind", "without the class", "another kind"
THRESHOLDS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.5)
SCORES = "crps", "brier", "rank"


def scene_of(kind: str, index: int) -> tuple[str, nbv.Surface]:
    """A validation scene's class and surface."""
    if kind == "parts":
        made = part_scene(Split.VALIDATION, index)
        return PART_CATEGORIES[index % len(PART_CATEGORIES)], nbv.SDFSurface(made.solid)
    thing = household_scene(Split.VALIDATION, index)
    return HOUSEHOLD[int(thing.label)], nbv.SDFSurface(thing)


def banks_of(kind: str, own: str) -> dict[str, tuple[nbv.ShapeBank, nbv.ShapePoses]]:
    """The banks that are compared."""
    bank, other = shape_bank(kind), OTHER[kind]
    others = [row for row, name in enumerate(bank.names) if kind_of(name) != own]
    poses = bank_poses(kind)
    return {
        OWN: (bank, poses),
        WITHOUT: (bank.chosen(others), poses),
        ANOTHER: (shape_bank(other), bank_poses(other)),
    }


def alone(planner: nbv.Planner) -> nbv.Planner:
    """One for whom the object is one of the shapes, however badly they fit."""
    model = planner.imagination.model
    assert isinstance(model, KnownShapes)
    certain = dataclasses.replace(model, unknown_misfit=1e6)
    return dataclasses.replace(planner, imagination=dataclasses.replace(planner.imagination, model=certain))


def run(kind: str, index: int) -> list[dict]:
    """A record for each number of views and each bank."""
    own, scene = scene_of(kind, index)
    key = jax.random.fold_in(jax.random.key(0), zlib.crc32(f"{kind} {index}".encode()))
    plain = planner_of(VARIANTS["default"])
    truth = Truth.of(scene, plain, sphere_candidates(24, 2.5), VOLUME, RAYS)
    planners = {NONE: plain}
    for name, (bank, poses) in banks_of(kind, own).items():
        planners[name] = dataclasses.replace(plain, imagination=plain.imagination.knowing(bank, poses))
        planners[f"{name}, alone"] = alone(planners[name])
    records, evidence, empty = [], None, None
    for view, (pose, scan) in enumerate(random_views(scene, jax.random.fold_in(key, 0))):
        evidence = plain.init(pose, scan) if evidence is None else plain.observe(evidence, pose, scan)
        empty = seen_space(scan, pose) if empty is None else empty | seen_space(scan, pose)
        for name, planner in planners.items():
            posterior = planner.imagination.posterior(evidence)
            surfaces = planner.imagination.sample(evidence, jax.random.fold_in(key, 1 + view), posterior)
            found = judge(planner, evidence, surfaces, truth, empty)._asdict()
            misfit = None if name == NONE else float(posterior.found.misfit[0])
            records.append({"bank": name, "views": view + 1, "misfit": misfit} | {key: found[key] for key in SCORES})
    return records


def _mean(rows: list[dict], what: str) -> float:
    return float(np.mean([row[what] for row in rows if row[what] is not None]))


def show(records: dict[str, list[dict]]) -> None:
    """Means by bank and number of views, and by threshold."""
    rows = [row for of in records.values() for row in of]
    for views in (1, 2):
        print(f"\nafter {views} view{'s' if views > 1 else ''}, {len(records)} objects")
        print(f"{'bank':28}{'CRPS':>8}{'Brier':>8}{'rank':>8}{'misfit':>8}")
        for name in dict.fromkeys(row["bank"] for row in rows):
            here = [row for row in rows if row["bank"] == name and row["views"] == views]
            cells = [_mean(here, what) for what in (*SCORES, *(["misfit"] if name != NONE else []))]
            print(f"{name:28}" + "".join(f"{cell:8.3f}" for cell in cells))
    print(f"\n{'threshold':28}{'CRPS':>8}{'Brier':>8}")
    for threshold in THRESHOLDS:
        chosen = []
        for of in records.values():
            base = {row["views"]: row for row in of if row["bank"] == NONE}
            certain = [row for row in of if row["bank"].endswith("alone")]
            chosen += [row if row["misfit"] < threshold else base[row["views"]] for row in certain]
        print(f"{threshold:<28}" + "".join(f"{_mean(chosen, what):8.3f}" for what in ("crps", "brier")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/known_shapes.json"))
    arguments = parser.parse_args()
    held = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    asked = [(kind, index) for index in range(arguments.scenes) for kind in OTHER]
    for kind, index in tqdm(asked):
        if f"{kind} {index}" not in held:
            held[f"{kind} {index}"] = run(kind, index)
            write_whole(arguments.out, lambda out: out.write(json.dumps(held).encode()))
    show({name: held[name] for name in (f"{kind} {index}" for kind, index in asked)})


if __name__ == "__main__":
    main()
