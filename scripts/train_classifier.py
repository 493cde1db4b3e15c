"""Train, calibrate and test a classifier that ships with jaxnbv: `python scripts/train_classifier.py truck`.

Two stages: clouds of true scans, then the same beside clouds whose last view is of a posterior sample, since those are
what an acquisition feeds the network; where little of a cloud tells the class, first which points do. Clouds and
checkpoints stay in the output folder, so that a run that was interrupted continues. One to two hours on one CPU core.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from cached import cached

from jaxnbv import Coverage, Grid, Planner, PointCloud
from jaxnbv.imagination import Imagination
from jaxnbv.networks import Focus, FocusedClassifier, InvariantClassifier, save_checkpoint
from jaxnbv.networks.pretrained import TRAINED_POINTS, TRAINED_SIDE
from jaxnbv.studies.scenes import CLASS_SETS, Framing, Split
from jaxnbv.studies.training import calibrate, expected_calibration_error, fit, log_probabilities, train
from jaxnbv.studies.training.class_clouds import LabelledClouds, imagined_clouds, scanned_clouds
from jaxnbv.tasks.classification import entropy

WEIGHTS = Path(__file__).parents[1] / "jaxnbv" / "networks" / "weights"
# Scenes whose posterior is sampled come from numbers that no scanned cloud uses.
FIRST_IMAGINED = 100_000
SCANNED_AT_ONCE = 100


class Recipe(NamedTuple):
    """What a network is trained on.

    - `framings`: how large the objects stand.
    - `solid`: whether they are nowhere thin, see `Imagination.preset`.
    - `scenes`: of which there are true scans, in each framing; `imagined`: of which there are imagined ones, 16 each.
    - `radii`, `groups`: of the network.
    - `focus`: steps of learning which points tell the class, where these are few; the classifier sees them alone.
    - `steps`: on true scans, or what of them tells the class, and on these beside imagined ones.
    """

    framings: tuple[Framing, ...] = (Framing.CLOSE_UP,)
    solid: bool = False
    scenes: int = 10_000
    imagined: int = 200
    radii: tuple[float, ...] = (0.25, 0.8)
    groups: tuple[int, ...] = (256, 64)
    focus: int = 0
    steps: tuple[int, int] = (8000, 4000)


RECIPES = {
    "pyramid": Recipe(tuple(Framing), solid=True, scenes=12_000, imagined=100),
    "truck": Recipe(scenes=16_000, imagined=100, groups=(192, 48), focus=2400, steps=(10_000, 5000)),
    "household": Recipe(scenes=8000, imagined=100, groups=(192, 48), steps=(4000, 1000)),
}


class Clouds:
    """The clouds of a set, made once and kept in a folder; in the network's units."""

    def __init__(self, name: str, folder: Path):
        self.set, self.recipe, self.folder = CLASS_SETS[name], RECIPES[name], folder
        self.points = TRAINED_POINTS[name]

    def scanned(self, split: Split, framing: Framing, count: int) -> LabelledClouds:
        """Clouds of true scans."""

        def make(first: int) -> LabelledClouds:
            return scanned_clouds(self.set, split, framing, range(first, first + SCANNED_AT_ONCE), self.points)

        folder, firsts = self.folder / f"scanned-{split}-{framing}", range(0, count, SCANNED_AT_ONCE)
        return self._scaled(framing, cached(folder, firsts, make))

    def imagined(self, split: Split, framing: Framing, count: int) -> LabelledClouds:
        """Clouds that end in a scan of a posterior sample, 16 from each of `count` scenes."""
        preset = Imagination.preset("screened", framing.longest_side, solid=self.recipe.solid)
        imagination = dataclasses.replace(preset, grid=Grid(64, 0.7 * framing.longest_side), num_samples=4)
        planner = Planner(Coverage(), imagination=imagination, capacity=2500)

        def make(index: int) -> LabelledClouds:
            return imagined_clouds(self.set, split, framing, index, planner, num_points=self.points)

        folder, indices = self.folder / f"imagined-{split}-{framing}", range(FIRST_IMAGINED, FIRST_IMAGINED + count)
        return self._scaled(framing, cached(folder, indices, make))

    def _scaled(self, framing: Framing, leaves: list[np.ndarray]) -> LabelledClouds:
        points, normals, mask, *rest = leaves
        return LabelledClouds(PointCloud(points * (TRAINED_SIDE / framing.longest_side), normals, mask), *rest)

    def joined(self, make, split: Split, count: int) -> LabelledClouds:
        """Clouds of all framings."""
        return concatenated(*(make(split, framing, count) for framing in self.recipe.framings))


def concatenated(*parts: LabelledClouds) -> LabelledClouds:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def informative(data: LabelledClouds) -> LabelledClouds:
    """All clouds that show the cue of the class, and a quarter of the others, of which there is little to learn."""
    turn = np.arange(len(data.labels)) // (data.labels.max() + 1)
    rows = (data.cue_pixels > 0) | (turn % 4 == 0)
    return jax.tree.map(lambda leaf: leaf[rows], data)


def thinned(data: LabelledClouds) -> LabelledClouds:
    """Each cloud cut to the first three eighths of its points or more, in farthest point order: studies feed fewer."""
    rows = data.clouds.mask.shape[1]
    count = np.random.default_rng(0).integers(3 * rows // 8, rows + 1, (len(data.labels), 1))
    mask = data.clouds.mask & (np.arange(rows) < count)
    return eqx.tree_at(lambda d: d.clouds.mask, data, mask)


def telling_alone(data: LabelledClouds, points: int = 320) -> LabelledClouds:
    """The points that tell the class, of the clouds that have twenty of them or more."""
    data = jax.tree.map(lambda leaf: leaf[data.on_cue.sum(axis=1) >= 20], data)
    order = np.argsort(~data.on_cue, axis=1, kind="stable")[:, :points]
    rows = np.arange(len(order))[:, None]
    cloud = PointCloud(data.clouds.points[rows, order], data.clouds.normals[rows, order], data.on_cue[rows, order])
    return eqx.tree_at(lambda d: (d.clouds, d.on_cue), data, (cloud, cloud.mask))


def focus_loss(focus: Focus, example: tuple[PointCloud, Any]) -> Any:
    """Cross-entropy of which points tell the class."""
    cloud, tells = example
    loss = optax.sigmoid_binary_cross_entropy(focus(cloud.points, cloud.normals, cloud.mask), tells)
    return jnp.sum(jnp.where(cloud.mask, loss, 0.0)) / jnp.maximum(cloud.count, 1)


@eqx.filter_jit
def chosen_clouds(network: FocusedClassifier, clouds: PointCloud) -> PointCloud:
    """What the network's classifier is fed of each cloud."""
    return jax.lax.map(lambda cloud: PointCloud(*network.chosen(cloud.points, cloud.normals, cloud.mask)), clouds)


def report(name: str, network: Any, data: LabelledClouds) -> None:
    """Accuracy and entropy by the telling pixels of the best view, on clouds of two or more views, and by the number of
    views; calibration."""
    log_p = log_probabilities(network, jax.tree.map(jnp.asarray, data.clouds))
    right = np.asarray(log_p).argmax(axis=1) == data.labels
    uncertain = np.asarray(entropy(log_p))
    print(f"{name}: calibration error {expected_calibration_error(log_p, data.labels):.3f}")
    for low, high in ((0, 1), (1, 150), (150, 500), (500, np.inf)):
        rows = (data.cue_pixels >= low) & (data.cue_pixels < high) & (data.views + data.imagined > 1)
        if rows.any():
            text = f"  {low:>4} to {high - 1:<4g} telling pixels: {rows.sum():5d} clouds"
            print(f"{text}, {right[rows].mean():6.1%} right, entropy {uncertain[rows].mean():.2f} nats")
    for views in range(1, 6):
        rows = data.views == views
        if rows.any():
            print(f"  {views} views: {rows.sum():5d} clouds, {right[rows].mean():6.1%} right")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", choices=sorted(RECIPES))
    parser.add_argument("--out", type=Path, help="default: runs/SET-network")
    parser.add_argument("--weights", type=Path, help="default: the package's")
    arguments = parser.parse_args()
    folder: Path = arguments.out or Path("runs") / f"{arguments.set}-network"
    folder.mkdir(parents=True, exist_ok=True)
    clouds, recipe = Clouds(arguments.set, folder), RECIPES[arguments.set]
    first, second = recipe.steps

    names = clouds.set.classes
    network: Any = InvariantClassifier(len(names), jax.random.key(0), recipe.radii, names, recipe.groups)
    scans = clouds.joined(clouds.scanned, Split.TRAIN, recipe.scenes)
    imagined = informative(clouds.joined(clouds.imagined, Split.TRAIN, recipe.imagined))
    if recipe.focus:
        alone = telling_alone(scans)
        network = train(network, alone.clouds, alone.labels, jax.random.key(3), first, folder=folder / "alone")
        both = informative(concatenated(thinned(scans), imagined))
        data, keys = (both.clouds, both.on_cue), jax.random.split(jax.random.key(4))
        # Every point is an example: few clouds make a batch.
        focus = fit(Focus(keys[0]), focus_loss, data, keys[1], recipe.focus, 8, folder=folder / "focus")
        chosen = chosen_clouds(FocusedClassifier(focus, network), both.clouds)
        network = train(network, chosen, both.labels, jax.random.key(2), second, folder=folder / "imagined")
        network = FocusedClassifier(focus, network)
    else:
        scans = thinned(informative(scans))
        network = train(network, scans.clouds, scans.labels, jax.random.key(1), first, folder=folder / "scanned")
        both = concatenated(scans, imagined)
        network = train(network, both.clouds, both.labels, jax.random.key(2), second, folder=folder / "imagined")

    held_out = clouds.joined(clouds.scanned, Split.VALIDATION, 1000)
    network = calibrate(network, jax.tree.map(jnp.asarray, held_out.clouds), held_out.labels)
    print(f"temperature {float(network.temperature):.3f}")
    for framing in recipe.framings:
        report(f"true scans, test split, {framing}", network, clouds.scanned(Split.TEST, framing, 1000))
    report("imagined scans, validation split", network, clouds.joined(clouds.imagined, Split.VALIDATION, 15))

    weights: Path = arguments.weights or WEIGHTS / f"{arguments.set}.safetensors"
    weights.parent.mkdir(parents=True, exist_ok=True)
    save_checkpoint(network, weights)
    print(f"{weights}   {weights.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
