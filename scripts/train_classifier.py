"""Train, calibrate and test a classifier that ships with jaxnbv: `python scripts/train_classifier.py truck`.

The first stage has clouds of true scans. The second adds clouds whose last view is of a posterior sample, since
acquisitions give such clouds to the network. If few points of a cloud tell the class, an earlier stage learns which
points do. Clouds and the network after each stage stay in the output folder, so that an interrupted run continues.
Takes one to two hours on one CPU core.
"""

import argparse
import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from training import calibrate, expected_calibration_error, fit, log_probabilities, train
from training_clouds import LabelledClouds, Source, concatenated

from jaxnbv import Coverage, Grid, Planner, PointCloud
from jaxnbv.networks import Focus, InvariantClassifier, save_checkpoint
from jaxnbv.networks.pretrained import TRAINED_POINTS, TRAINED_SIDE
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.studies.scenes import (
    HOUSEHOLD,
    PATTERNS,
    ClassSet,
    Framing,
    Split,
    household_scene,
    pyramid_scene,
    truck_scene,
)
from jaxnbv.tasks.classification import entropy

WEIGHTS = Path(__file__).parents[1] / "jaxnbv" / "networks" / "weights"


class Recipe(NamedTuple):
    """Training data and steps of a network.

    - `objects`: the scenes and their classes.
    - `framings`: sizes of the objects.
    - `solid`: whether no object is thin, see `SurfaceSampler.preset`.
    - `scenes`: number of scenes with true scans, in each framing. 100 scenes have 16 imagined scans each.
    - `groups`: of the network.
    - `focus`: steps of learning which points tell the class, if these are few. The classifier then gets only these.
    - `steps`: steps of the first and of the second stage.
    """

    objects: ClassSet
    framings: tuple[Framing, ...] = (Framing.CLOSE_UP,)
    solid: bool = False
    scenes: int = 10_000
    groups: tuple[int, ...] = (192, 48)
    focus: int = 0
    steps: tuple[int, int] = (8000, 4000)


RECIPES = {
    "pyramid": Recipe(ClassSet(PATTERNS, pyramid_scene), tuple(Framing), solid=True, scenes=12_000, groups=(256, 64)),
    "truck": Recipe(ClassSet(HOUSEHOLD, truck_scene), scenes=16_000, focus=2400, steps=(10_000, 5000)),
    "household": Recipe(ClassSet(HOUSEHOLD, household_scene), scenes=8000, steps=(4000, 1000)),
}


def source(name: str, framing: Framing, folder: Path) -> Source:
    """The clouds of a set's objects in a framing."""
    preset = SurfaceSampler.preset("screened", framing.longest_side, solid=RECIPES[name].solid)
    sampler = dataclasses.replace(preset, grid=Grid(64, 0.7 * framing.longest_side), num_samples=4)
    planner = Planner(Coverage(), sampler=sampler, capacity=2500)
    scene = functools.partial(RECIPES[name].objects.scene, framing=framing)
    return Source(folder / framing, scene, planner, TRAINED_POINTS[name], scale=TRAINED_SIDE / framing.longest_side)


def informative(data: LabelledClouds) -> LabelledClouds:
    """All clouds that show the cue of the class, and a quarter of the others, which teach little."""
    round_index = np.arange(len(data.labels)) // (data.labels.max() + 1)
    rows = (data.cue_pixels > 0) | (round_index % 4 == 0)
    return jax.tree.map(lambda leaf: leaf[rows], data)


def thinned(data: LabelledClouds) -> LabelledClouds:
    """Each cloud cut at random to its first 3/8 or more, in farthest point order, since studies use fewer points."""
    rows = data.clouds.mask.shape[1]
    count = np.random.default_rng(0).integers(3 * rows // 8, rows + 1, (len(data.labels), 1))
    mask = data.clouds.mask & (np.arange(rows) < count)
    return eqx.tree_at(lambda d: d.clouds.mask, data, mask)


def telling_alone(data: LabelledClouds, points: int = 320) -> LabelledClouds:
    """Clouds of only the points that tell the class, if there are twenty or more."""
    data = jax.tree.map(lambda leaf: leaf[data.point_labels.sum(axis=1) >= 20], data)
    order = np.argsort(~data.point_labels, axis=1, kind="stable")[:, :points]
    rows = np.arange(len(order))[:, None]
    tells = data.point_labels[rows, order]
    cloud = PointCloud(data.clouds.points[rows, order], data.clouds.normals[rows, order], tells)
    return eqx.tree_at(lambda d: (d.clouds, d.point_labels), data, (cloud, tells))


def focus_loss(focus: Focus, example: tuple[PointCloud, Any]) -> Any:
    """Cross-entropy of the prediction whether each point tells the class."""
    cloud, tells = example
    loss = optax.sigmoid_binary_cross_entropy(focus(cloud.points, cloud.normals, cloud.mask), tells)
    return jnp.sum(jnp.where(cloud.mask, loss, 0.0)) / jnp.maximum(cloud.count, 1)


@eqx.filter_jit
def chosen_clouds(focus: Focus, clouds: PointCloud) -> PointCloud:
    """The points of each cloud that a focused classifier uses."""
    return jax.lax.map(lambda cloud: PointCloud(*focus.select(cloud.points, cloud.normals, cloud.mask)), clouds)


def report(name: str, network: Any, data: LabelledClouds) -> None:
    """Print calibration, and accuracy and entropy by the number of views, and by the pixels of the cue in the best view
    for clouds of two or more views."""
    log_p = log_probabilities(network, jax.tree.map(jnp.asarray, data.clouds))
    right = np.asarray(log_p).argmax(axis=1) == data.labels
    uncertain = np.asarray(entropy(log_p))
    print(f"{name}: calibration error {expected_calibration_error(log_p, data.labels):.3f}")
    for low, high in ((0, 1), (1, 150), (150, 500), (500, np.inf)):
        rows = (data.cue_pixels >= low) & (data.cue_pixels < high) & (data.views + data.imagined > 1)
        if rows.any():
            text = f"  {low:>4} to {high - 1:<4g} telling pixels: {rows.sum():5d} clouds"
            print(f"{text}, {right[rows].mean():6.1%} right, entropy {uncertain[rows].mean():.2f} nats")
    for views in np.unique(data.views):
        rows = data.views == views
        print(f"  {views} views: {rows.sum():5d} clouds, {right[rows].mean():6.1%} right")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", choices=sorted(RECIPES))
    parser.add_argument("--out", type=Path, help="default: runs/SET-network")
    parser.add_argument("--weights", type=Path, help="default: the package's")
    arguments = parser.parse_args()
    folder: Path = arguments.out or Path("runs") / f"{arguments.set}-network"
    recipe, names = RECIPES[arguments.set], RECIPES[arguments.set].objects.classes
    sources = {framing: source(arguments.set, framing, folder) for framing in recipe.framings}
    first, second = recipe.steps

    network: Any = InvariantClassifier(len(names), jax.random.key(0), classes=names, groups=recipe.groups)
    scans = concatenated(*(one.scanned(Split.TRAIN, recipe.scenes) for one in sources.values()))
    imagined = informative(concatenated(*(one.imagined(Split.TRAIN, 100) for one in sources.values())))
    if recipe.focus:
        alone = telling_alone(scans)
        network = train(network, alone.clouds, alone.labels, jax.random.key(3), first, file=folder / "alone.eqx")
        both = informative(concatenated(thinned(scans), imagined))
        data, keys = (both.clouds, both.point_labels), jax.random.split(jax.random.key(4))
        # Every point is an example, so a batch needs few clouds.
        focus = fit(Focus(keys[0]), focus_loss, data, keys[1], recipe.focus, 8, file=folder / "focus.eqx")
        focused = chosen_clouds(focus, both.clouds)
        network = train(network, focused, both.labels, jax.random.key(2), second, file=folder / "imagined.eqx")
        network = eqx.tree_at(lambda net: net.focus, network, focus, is_leaf=lambda leaf: leaf is None)
    else:
        scans = thinned(informative(scans))
        network = train(network, scans.clouds, scans.labels, jax.random.key(1), first, file=folder / "scanned.eqx")
        both = concatenated(scans, imagined)
        network = train(network, both.clouds, both.labels, jax.random.key(2), second, file=folder / "imagined.eqx")

    held_out = concatenated(*(one.scanned(Split.VALIDATION, 1000) for one in sources.values()))
    network = calibrate(network, jax.tree.map(jnp.asarray, held_out.clouds), held_out.labels)
    print(f"temperature {float(network.temperature):.3f}")
    for framing, one in sources.items():
        report(f"true scans, test split, {framing}", network, one.scanned(Split.TEST, 1000))
        report(f"imagined scans, validation split, {framing}", network, one.imagined(Split.VALIDATION, 15))

    weights: Path = arguments.weights or WEIGHTS / f"{arguments.set}.safetensors"
    save_checkpoint(network, weights)
    print(f"{weights}   {weights.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
