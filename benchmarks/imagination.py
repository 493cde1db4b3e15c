"""Quality of imagined surfaces: samples of several models against the true surface, after one view and after two.

    python benchmarks/imagination.py [--scenes N] [--parts NAME ...] [--mesh FILE ...] [--candidates 24] [--seeds 0 1]
        [--models NAME ...] [--variant "NAME=EXPRESSION" ...] [--figure PATH] [--reliability PATH]
        [--known FOLDER] [--better NAME] [--out FILE]

Objects are N validation pyramids in close-up, one validation object of each named part category, and the demo object.
With --mesh they are the meshes, and those of --scenes and --parts if given. All models see the same scans of 50 x 50
rays with the default noise, from the same two random views. There are 8 samples on a grid of 64^3 nodes. Depths are
along 32 x 32 rays from each candidate. See `forecasts.py` for the scores. Runs only what is not in the file yet.

With --known the model "known" is the default model with a bank of the folder's meshes, upright, without the object.

A variant is a model of your own, carved: --variant "smooth=nbv.GeometricSPSR(lengthscale=0.03, truncation=32)". All of
jaxnbv, jaxnbv.surfaces and the grid are in scope. If you change the code of a model, use another file.
"""

import argparse
import dataclasses
import functools
import hashlib
import json
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from forecasts import Truth, judge
from imagination_figures import draw_reliability, draw_samples
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv import surfaces as models
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.storage import describe
from jaxnbv.storage.files import write_whole
from jaxnbv.storage.folders import versions
from jaxnbv.studies.scenes import PART_CATEGORIES, Split, demo_object, part_scene, pyramid_scene

GRID = nbv.Grid(64, 0.7 * 2.5)
RAYS = nbv.Camera(height=32, width=32)
VOLUME = nbv.Box()
VIEWS, MIN_HITS = 2, 100

Variant = Callable[[nbv.Grid], tuple[nbv.SurfaceModel, nbv.Carving | None]]
TWO_SCALES = nbv.ScreenedSPSR().base
VARIANTS: dict[str, Variant] = {
    "paper": lambda grid: (nbv.GeometricSPSR(), None),
    "+ carving": lambda grid: (nbv.GeometricSPSR(), nbv.Carving()),
    "+ volume": lambda grid: (nbv.ScreenedSPSR(nbv.GeometricSPSR(), (nbv.surfaces.OutsideBoundary(),)), nbv.Carving()),
    "+ two scales": lambda grid: (nbv.ScreenedSPSR(TWO_SCALES, (nbv.surfaces.OutsideBoundary(),)), nbv.Carving()),
    "+ on surface": lambda grid: (
        nbv.ScreenedSPSR(values=(nbv.surfaces.OutsideBoundary(), nbv.surfaces.OnSurface())),
        nbv.Carving(),
    ),
    "default": lambda grid: (nbv.ScreenedSPSR(), nbv.Carving()),
}
# Columns of the table: heading, key of the record, digits.
COLUMNS = (
    ("CRPS", "crps", 4),
    ("Brier", "brier", 4),
    ("fair", "fair_brier", 4),
    ("P(in)", "mean_inside", 3),
    ("true", "true_inside", 3),
    ("in empty", "in_empty", 3),
    ("rank", "rank", 2),
    ("of best", "share_of_best", 2),
)


def planner_of(variant: Variant) -> nbv.Planner:
    """The planner whose samples are judged. Its search is not used."""
    model, carving = variant(GRID)
    sampler = nbv.SurfaceSampler(model, GRID, 8, carving)
    return nbv.Planner(nbv.Coverage(), sampler=sampler, capacity=4096, max_views=VIEWS)


def objects_of(arguments: argparse.Namespace) -> dict[str, Callable[[], nbv.scanning.Surface]]:
    """Functions that make the objects, by the name "class/object"."""
    alone = not arguments.mesh
    scenes = (2 if alone else 0) if arguments.scenes is None else arguments.scenes
    parts = (["chair", "mug", "motorbike"] if alone else []) if arguments.parts is None else arguments.parts
    makers: dict[str, Callable[[], nbv.scanning.Surface]] = {}
    for index in range(scenes):
        makers[f"pyramid/{index}"] = lambda i=index: nbv.SDFSurface(pyramid_scene(Split.VALIDATION, i))
    for name in parts:
        index = PART_CATEGORIES.index(name)
        makers[f"parts/{name}"] = lambda i=index: nbv.SDFSurface(part_scene(Split.VALIDATION, i).solid)
    if alone:
        makers["demo/mug"] = demo_object
    for file in map(Path, arguments.mesh):
        makers[f"{file.resolve().parent.name}/{file.stem}"] = functools.partial(nbv.load_mesh, file)
    return makers


def with_bank(planner: nbv.Planner, bank: nbv.ShapeBank, name: str) -> nbv.Planner:
    """A planner with the shapes of a bank, without the object of this name."""
    others = [row for row, shape_name in enumerate(bank.names) if shape_name != name]
    sampler = planner.sampler.with_bank(bank.select(others), nbv.surfaces.Upright(by_axis=True))
    return dataclasses.replace(planner, sampler=sampler)


def random_views(scene: nbv.scanning.Surface, key: jax.Array) -> list[tuple[nbv.Pose, nbv.PointCloud]]:
    """Views from random directions that each see some of the object."""
    views = []
    for index in range(100):
        direction_key, noise_key = jax.random.split(jax.random.fold_in(key, index))
        direction = jax.random.normal(direction_key, (3,))
        pose = nbv.look_at(2.5 * direction / jnp.linalg.norm(direction))
        cloud = observe_scene(scene, nbv.Camera(), pose, nbv.SensorNoise(), noise_key)
        views += [(pose, cloud)] if int(cloud.count) >= MIN_HITS else []
        if len(views) == VIEWS:
            return views
    raise SystemExit(f"the object shows from fewer than {VIEWS} of 100 random directions: give a larger one")


@eqx.filter_jit
def seen_space(scan: nbv.PointCloud, pose: nbv.Pose) -> jax.Array:
    """Nodes that one scan shows to be empty, by the default carving for all models."""
    return nbv.Carving().empty_nodes(GRID, pose, scan, nbv.Camera())


def run(planner: nbv.Planner, views: list, truth: Truth, key: jax.Array, compiled: bool) -> list[dict]:
    """One record for each number of views. Seconds do not include compilation."""
    records, observations, empty = [], None, jnp.zeros((GRID.resolution,) * 3, bool)
    for index, (pose, scan) in enumerate(views):
        observations = planner.init(pose, scan) if observations is None else planner.observe(observations, pose, scan)
        empty = empty | seen_space(scan, pose)
        sample = functools.partial(planner.sampler.sample, observations, jax.random.fold_in(key, index))
        if index == 0 and not compiled:
            jax.block_until_ready(sample())
        start = time.perf_counter()
        surfaces = jax.block_until_ready(sample())
        seconds = time.perf_counter() - start
        record = judge(planner, observations, surfaces, truth, empty)._asdict()
        record["reliability"] = record["reliability"] and record["reliability"]._asdict()
        records.append(record | {"views": index + 1, "points": int(observations.cloud.count), "seconds": seconds})
    return records


def show(rows: dict[tuple[str, int, str], list[dict]], names: list[str]) -> None:
    """Print means over objects and seeds, and the paired differences to the first model."""
    pairs = list(dict.fromkeys((name, seed) for name, seed, _ in rows))
    objects = list(dict.fromkeys(name for name, _ in pairs))
    wide = max(map(len, [*names, "model"])) + 2

    def values(model: str, views: int, what: str, within: str | None = None) -> np.ndarray:
        cells = [rows[name, seed, model][views][what] for name, seed in pairs if within in (None, name)]
        return np.array([cell for cell in cells if cell is not None], float)

    for views in range(VIEWS):
        print(f"\nafter {views + 1} view{'s' if views else ''}: means of {len(objects)} objects, {len(pairs)} runs")
        print(f"{'model':{wide}}" + "".join(f"{head:>10}" for head, _, _ in COLUMNS) + f"{'seconds':>10}")
        for model in names:
            cells = [(values(model, views, key), digits) for _, key, digits in COLUMNS]
            text = "".join(f"{c.mean():10.{digits}f}" if len(c) else f"{'-':>10}" for c, digits in cells)
            print(f"{model:{wide}}{text}{np.median(values(model, views, 'seconds')):10.2f}")
        for what in ("crps", "fair_brier"):
            print(f"change of {what} against {names[0]}, %: mean of the objects, and by class the mean (worst object)")
            for model in names[1:]:
                change: dict[str, list[float]] = {}
                for name in objects:
                    base = values(names[0], views, what, name)
                    if len(base):
                        ratio = values(model, views, what, name).mean() / base.mean()
                        change.setdefault(name.split("/")[0], []).append(100.0 * (ratio - 1.0))
                if change:
                    mean = np.mean([change_of_object for group in change.values() for change_of_object in group])
                    text = "  ".join(f"{kind} {np.mean(c):+.0f} ({max(c):+.0f})" for kind, c in change.items())
                    print(f"{model:{wide}}{mean:+7.0f}   {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mesh", nargs="+", default=[], help="mesh files")
    parser.add_argument("--scenes", type=int, help="pyramids; 2 if left out, none with meshes")
    parser.add_argument("--parts", nargs="*", choices=PART_CATEGORIES, help="categories; three if left out")
    parser.add_argument("--candidates", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--models", nargs="+", help="names of variants, all if left out; the first is compared with")
    parser.add_argument("--variant", action="append", default=[], metavar="NAME=EXPRESSION", help="a model to add")
    parser.add_argument("--figure", type=Path, help="a picture of the first object, by the first model and --better")
    parser.add_argument("--reliability", type=Path, help="a picture of the first model's reliability and --better's")
    parser.add_argument("--known", type=Path, help="a folder of meshes, class/name, for the model known")
    parser.add_argument("--better", help="the second model of the pictures; the last if left out")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/imagination.json"))
    arguments = parser.parse_args()

    variants = dict(VARIANTS)
    for text in arguments.variant:
        name, _, expression = text.partition("=")
        scope = {**vars(models), **vars(nbv), "nbv": nbv, "grid": GRID}
        model = eval(expression, scope)
        variants[name] = lambda grid, model=model: (model, nbv.Carving())
    bank = None if arguments.known is None else nbv.ShapeBank.from_meshes(arguments.known)
    if bank is not None:
        variants["known"] = VARIANTS["default"]
    names = arguments.models or list(variants)
    if unknown := set(names) - set(variants):
        parser.error(f"there is no model {', '.join(sorted(unknown))}: choose from {', '.join(variants)}")
    pair = names[0], arguments.better or names[-1]
    if pair[1] not in names:
        parser.error(f"--better {pair[1]} is none of the models that are compared: {', '.join(names)}")
    planners = {name: planner_of(variants[name]) for name in names}
    candidates = sphere_candidates(arguments.candidates, 2.5)
    stored = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    rows, compiled_models = {}, set[str]()
    objects = objects_of(arguments)
    with tqdm(total=len(objects) * len(arguments.seeds) * len(names), unit="run") as bar:
        for name, make in objects.items():
            scene, truth = make(), None
            for seed in arguments.seeds:
                base, views = jax.random.fold_in(jax.random.key(seed), zlib.crc32(name.encode())), None
                for model, plain in planners.items():
                    planner = with_bank(plain, bank, name) if bank is not None and model == "known" else plain
                    settings = describe([scene, planner, arguments.candidates, RAYS, VOLUME, MIN_HITS])
                    label = f"{name}, seed {seed}, {model}"
                    bar.set_description(label)
                    digest = hashlib.sha256(json.dumps(settings).encode()).hexdigest()
                    if stored.get(label, {}).get("made_of") != digest:
                        truth = truth or Truth.of(scene, planner, candidates, VOLUME, RAYS)
                        views = views or random_views(scene, jax.random.fold_in(base, 0))
                        records = run(planner, views, truth, jax.random.fold_in(base, 1), model in compiled_models)
                        compiled_models.add(model)
                        stored[label] = {"made_of": digest, "versions": versions(), "records": records}
                        arguments.out.parent.mkdir(parents=True, exist_ok=True)
                        write_whole(
                            arguments.out, lambda out: out.write((json.dumps(stored, indent=1) + "\n").encode())
                        )
                    rows[name, seed, model] = stored[label]["records"]
                    bar.update()
    show(rows, names)
    if arguments.reliability:
        draw_reliability(arguments.reliability, rows, pair)
    if arguments.figure:
        name, make = next(iter(objects.items()))
        base = jax.random.fold_in(jax.random.key(arguments.seeds[0]), zlib.crc32(name.encode()))
        by_model = {model: planners[model] for model in pair}
        scene = make()
        first = random_views(scene, jax.random.fold_in(base, 0))[0]
        draw_samples(arguments.figure, scene, first, by_model, jax.random.fold_in(base, 1))


if __name__ == "__main__":
    main()
