"""Train and test the part segmenter that ships with jaxnbv: `python scripts/train_parts.py`.

Clouds of true scans of procedural objects, and beside them clouds that end in a scan of a posterior sample, since those
are what an acquisition feeds the network. Clouds and checkpoints stay in the output folder, so that a run that was
interrupted continues. Half an hour on two CPU cores.
"""

import argparse
import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from cached import cached

from jaxnbv import Coverage, Grid, Planner, PointCloud
from jaxnbv.imagination import Imagination
from jaxnbv.networks import CATEGORIES, CompactPartSegmenter, part_mask, save_checkpoint
from jaxnbv.networks.pretrained import TRAINED_SIDE
from jaxnbv.scanning.sensors import PART_SETTING
from jaxnbv.studies.scenes import Split
from jaxnbv.studies.training import fit
from jaxnbv.studies.training.part_clouds import LabelledPartClouds, imagined_part_clouds, scanned_part_clouds

WEIGHTS = Path(__file__).parents[1] / "jaxnbv" / "networks" / "weights" / "parts.safetensors"
# Scenes whose posterior is sampled come from numbers that no scanned cloud uses.
FIRST_IMAGINED = 100_000
SCALE = 2.0 / TRAINED_SIDE


def scanned(folder: Path, split: Split, count: int) -> LabelledPartClouds:
    """Clouds of true scans, three a scene."""

    def make(first):
        return scanned_part_clouds(split, range(first, first + 100))

    return _clouds(cached(folder / f"scanned-{split}", range(0, count, 100), make))


def imagined(folder: Path, split: Split, count: int) -> LabelledPartClouds:
    """Clouds that end in a scan of a posterior sample, 16 from each of `count` scenes."""
    imagination = dataclasses.replace(Imagination.preset(), grid=Grid(64), num_samples=4)
    planner = Planner(Coverage(), camera=PART_SETTING.camera, imagination=imagination, capacity=2500)

    def make(index):
        return imagined_part_clouds(split, [index], planner)

    scenes = range(FIRST_IMAGINED, FIRST_IMAGINED + count)
    return _clouds(cached(folder / f"imagined-{split}", scenes, make))


def _clouds(leaves: list[np.ndarray]) -> LabelledPartClouds:
    points, normals, mask, labels, categories = leaves
    return LabelledPartClouds(PointCloud(points, normals, mask), labels, categories)


def log_probabilities(network: CompactPartSegmenter, example: LabelledPartClouds):
    """log p of the parts of the cloud's category, point by point; very low for the parts of others."""
    cloud = example.clouds
    log_p = network(SCALE * cloud.points, cloud.normals, example.categories, cloud.mask)
    allowed = jnp.asarray(part_mask())[example.categories]
    return jax.nn.log_softmax(jnp.where(allowed, log_p, -1e9))


def loss(network: CompactPartSegmenter, example: LabelledPartClouds):
    """Mean of -log p(label) over the points that are there."""
    of_points = -jnp.take_along_axis(log_probabilities(network, example), example.labels[:, None], axis=1)[:, 0]
    mask = example.clouds.mask
    return jnp.sum(jnp.where(mask, of_points, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


@eqx.filter_jit
def predicted(network: CompactPartSegmenter, data: LabelledPartClouds):
    """The likeliest part of every point, and its probability."""

    def of_cloud(example):
        log_p = log_probabilities(network, example)
        return jnp.argmax(log_p, axis=1), jnp.exp(jnp.max(log_p, axis=1))

    return jax.lax.map(of_cloud, data)


def report(name: str, network: CompactPartSegmenter, data: LabelledPartClouds) -> None:
    """Accuracy over points and intersection over union, mean over the parts of a category."""
    labels, confidence = (np.asarray(array) for array in predicted(network, jax.tree.map(jnp.asarray, data)))
    mask, right = data.clouds.mask, labels == data.labels
    print(f"{name}: {right[mask].mean():.1%} of points right, mean confidence {confidence[mask].mean():.1%}")
    for index in np.unique(data.categories):
        rows = data.categories == index
        shown, said, true = mask[rows], labels[rows], data.labels[rows]
        ratios = []
        for part in CATEGORIES[index].labels:
            either = shown & ((said == part) | (true == part))
            if either.any():
                ratios.append((either & (said == true)).sum() / either.sum())
        accuracy = (said == true)[shown].mean()
        text = ", ".join(f"{ratio:.2f}" for ratio in ratios)
        print(f"  {CATEGORIES[index].name:12} {accuracy:6.1%} of points, intersection over union {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/part-network"))
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    arguments = parser.parse_args()
    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)

    parts = scanned(folder, Split.TRAIN, 2000), imagined(folder, Split.TRAIN, 130)
    clouds = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    network = CompactPartSegmenter(jax.random.key(0))
    network = fit(network, loss, clouds, jax.random.key(1), 3000, folder=folder)
    report("true scans, test split", network, scanned(folder, Split.TEST, 300))
    report("imagined scans, validation split", network, imagined(folder, Split.VALIDATION, 13))

    save_checkpoint(network, arguments.weights)
    print(f"{arguments.weights}   {arguments.weights.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
