"""Calibration of the weights of known shapes: how often the likeliest kind of shape is the true one.

    python benchmarks/shape_weights.py [--scenes 30] [--kinds NAME ...] [--out FILE]

Uses N validation scenes of each study of classes, with the shipped bank. The first view is the study's, the next two
are random. Prints after one to three views how often the likeliest kind is the true one, its mean weight, the mean
weights of the true kind and of "none of these", and the expected calibration error in ten bins, which needs all views
together to fill them. Runs only what is not in the file yet.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from jaxnbv.planning.loop import view_keys
from jaxnbv.storage.files import write_whole
from jaxnbv.studies.classification.objects import HouseholdStudy, PyramidStudy, TruckStudy
from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.engine.measures import KNOWN
from jaxnbv.studies.scenes import Framing, Split
from jaxnbv.surfaces import KnownShapesPosterior
from jaxnbv.surfaces.known_shapes import NONE

VIEWS = 3
KINDS: dict[str, type[ClassificationStudy]] = {
    "pyramid": PyramidStudy,
    "truck": TruckStudy,
    "household": HouseholdStudy,
}


def study_of(kind: str) -> ClassificationStudy:
    """The study of a kind on the validation split."""
    studies = KINDS[kind].configured(KNOWN, VIEWS, False, split=Split.VALIDATION, framing=Framing.CLOSE_UP)
    (study,) = studies.values()
    assert isinstance(study, ClassificationStudy)
    return study


def weights(study: ClassificationStudy, index: int) -> dict:
    """The true class, and the weights of each class and of none after each view."""
    scene = study.scene(index)
    planner, sensor, poses = study.planner("coverage", scene), study.sensor(scene), study.candidates.poses()
    first = study.first_view(scene)
    order = jax.random.permutation(study.key(index, "measure"), study.num_candidates).tolist()
    observations, rows = None, []
    for view, candidate in enumerate([first, *(index for index in order if index != first)][:VIEWS]):
        pose = poses[candidate]
        scan = sensor(pose, view_keys(study.key(index, "episode"), view)[2])
        observations = planner.init(pose, scan) if observations is None else planner.observe(observations, pose, scan)
        posterior = planner.sampler.posterior(observations)
        assert isinstance(posterior, KnownShapesPosterior)
        kinds = posterior.kinds()
        rows.append([kinds.get(name, 0.0) for name in (*study.objects.classes, NONE)])
    return {"label": scene.task.label, "weights": rows}


def show(kind: str, records: list[dict]) -> None:
    """Print a line for each number of views, and one for all."""
    labels = np.array([record["label"] for record in records])
    weight_rows = np.array([record["weights"] for record in records])
    for view in range(VIEWS):
        _line(f"{kind}, {view + 1} views", weight_rows[:, view], labels)
    _line(f"{kind}, all", weight_rows.reshape(-1, weight_rows.shape[-1]), np.repeat(labels, VIEWS))


def _line(name: str, rows: np.ndarray, labels: np.ndarray) -> None:
    right, true = rows.argmax(axis=1) == labels, rows[np.arange(len(rows)), labels]
    likeliest = rows.max(axis=1)
    gaps = np.bincount(np.minimum(10 * likeliest, 9).astype(int), weights=likeliest - right)
    error = np.abs(gaps).sum() / len(rows)
    cells = right.mean(), likeliest.mean(), true.mean(), rows[:, -1].mean(), error
    print(f"{name:22}{len(rows):7}" + "".join(f"{cell:10.2f}" for cell in cells))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/shape_weights.json"))
    arguments = parser.parse_args()
    results = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    for kind in arguments.kinds:
        study = study_of(kind)
        for index in tqdm(range(arguments.scenes), kind):
            if f"{kind} {index}" not in results:
                results[f"{kind} {index}"] = weights(study, index)
                write_whole(arguments.out, lambda out: out.write(json.dumps(results).encode()))
    heads = "views", "right", "likeliest", "true", "none", "error"
    print(f"{'':22}{heads[0]:>7}" + "".join(f"{head:>10}" for head in heads[1:]))
    for kind in arguments.kinds:
        show(kind, [results[f"{kind} {index}"] for index in range(arguments.scenes)])


if __name__ == "__main__":
    main()
