"""Train, calibrate and test the pyramid classifier that ships with jaxnbv: `python scripts/train_pyramid.py`.

Two stages: clouds of true scans, then the same beside clouds whose last view is of a posterior sample, since those are
what an acquisition feeds the network. Clouds and checkpoints stay in the output folder, so that a run that was
interrupted continues. An hour and a quarter on one CPU core.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from cached import cached

from jaxnbv import Camera, Coverage, DiscreteSearch, Grid, Planner, PointCloud
from jaxnbv.datasets import PATTERNS, Framing, Split
from jaxnbv.networks import InvariantClassifier, save_checkpoint
from jaxnbv.networks.pretrained import TRAINED_SIDE
from jaxnbv.presets import ModelName, imagination
from jaxnbv.tasks.classification import entropy
from jaxnbv.training import calibrate, expected_calibration_error, log_probabilities, train
from jaxnbv.training.pyramid_clouds import LabelledClouds, imagined_clouds, scanned_clouds

WEIGHTS = Path(__file__).parents[1] / "jaxnbv" / "networks" / "weights" / "pyramid.safetensors"
# Scenes whose posterior is sampled come from numbers that no scanned cloud uses.
FIRST_IMAGINED = 100_000
SCANNED_AT_ONCE = 100


def scanned(folder: Path, split: Split, framing: Framing, count: int) -> LabelledClouds:
    """Clouds of true scans."""

    def make(first):
        return scanned_clouds(split, framing, jnp.asarray(first), SCANNED_AT_ONCE)

    return _clouds(cached(folder / f"scanned-{split}-{framing}-{count}.npz", range(0, count, SCANNED_AT_ONCE), make))


def imagined(folder: Path, split: Split, framing: Framing, count: int) -> LabelledClouds:
    """Clouds that end in a scan of a posterior sample, 16 from each of `count` scenes."""
    model, carving = imagination(ModelName.SCREENED, framing.longest_side, solid=True)
    grid = Grid(64, 0.7 * framing.longest_side)
    planner = Planner(model, Camera(), Coverage(), DiscreteSearch(), 4, grid, 2500, carving=carving)

    def make(index):
        return imagined_clouds(split, framing, jnp.asarray(index), planner)

    scenes = range(FIRST_IMAGINED, FIRST_IMAGINED + count)
    return _clouds(cached(folder / f"imagined-{split}-{framing}-{count}.npz", scenes, make))


def _clouds(leaves: list[np.ndarray]) -> LabelledClouds:
    points, normals, mask, *rest = leaves
    return LabelledClouds(PointCloud(points, normals, mask), *rest)


def scaled(folder: Path, make, split: Split, framing: Framing, count: int) -> LabelledClouds:
    """Clouds in the network's units."""
    data = make(folder, split, framing, count)
    return eqx.tree_at(lambda d: d.clouds.points, data, data.clouds.points * (TRAINED_SIDE / framing.longest_side))


def joined(folder: Path, make, split: Split, count: int) -> LabelledClouds:
    """Clouds of both framings, in the network's units."""
    return concatenated(*(scaled(folder, make, split, framing, count) for framing in Framing))


def concatenated(*parts: LabelledClouds) -> LabelledClouds:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def informative(data: LabelledClouds) -> LabelledClouds:
    """All clouds that show the pattern, and a quarter of the others, of which there is little to learn."""
    rows = (data.pattern_pixels > 0) | (np.arange(len(data.labels)) // len(PATTERNS) % 4 == 0)
    return jax.tree.map(lambda leaf: leaf[rows], data)


def thinned(data: LabelledClouds) -> LabelledClouds:
    """Each cloud cut to the first 384 to 1,024 of its points, in farthest point order: studies feed it fewer too."""
    count = np.random.default_rng(0).integers(384, 1025, (len(data.labels), 1))
    mask = data.clouds.mask & (np.arange(data.clouds.mask.shape[1]) < count)
    return eqx.tree_at(lambda d: d.clouds.mask, data, mask)


def report(name: str, network: InvariantClassifier, data: LabelledClouds) -> None:
    """Accuracy and entropy by the most pattern pixels seen in one view, on clouds of two or more views; calibration."""
    log_p = log_probabilities(network, jax.tree.map(jnp.asarray, data.clouds))
    right = np.asarray(log_p).argmax(axis=1) == data.labels
    uncertain = np.asarray(entropy(log_p))
    print(f"{name}: calibration error {expected_calibration_error(log_p, data.labels):.3f}")
    for low, high in ((0, 1), (1, 150), (150, 500), (500, np.inf)):
        rows = (data.pattern_pixels >= low) & (data.pattern_pixels < high) & (data.views + data.imagined > 1)
        if rows.any():
            text = f"  {low:>4} to {high - 1:<4g} pixels of pattern: {rows.sum():5d} clouds"
            print(f"{text}, {right[rows].mean():6.1%} right, entropy {uncertain[rows].mean():.2f} nats")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/pyramid-network"))
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    arguments = parser.parse_args()
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)

    scans = thinned(informative(joined(folder, scanned, Split.TRAIN, 12_000)))
    network = InvariantClassifier(len(PATTERNS), jax.random.key(0), classes=PATTERNS)
    network = train(network, scans.clouds, scans.labels, jax.random.key(1), 8000, folder=folder / "scanned")
    both = concatenated(scans, informative(joined(folder, imagined, Split.TRAIN, 100)))
    network = train(network, both.clouds, both.labels, jax.random.key(2), 4000, folder=folder / "imagined")

    held_out = joined(folder, scanned, Split.VALIDATION, 1000)
    network = calibrate(network, jax.tree.map(jnp.asarray, held_out.clouds), held_out.labels)
    print(f"temperature {float(network.temperature):.3f}")
    for framing in Framing:
        report(f"true scans, test split, {framing}", network, scaled(folder, scanned, Split.TEST, framing, 1000))
    report("imagined scans, validation split", network, joined(folder, imagined, Split.VALIDATION, 15))

    arguments.weights.parent.mkdir(parents=True, exist_ok=True)
    save_checkpoint(network, arguments.weights)
    print(f"{arguments.weights}   {arguments.weights.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
