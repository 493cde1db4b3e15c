"""Train and test the part segmenter that ships with jaxnbv: `python scripts/train_parts.py`.

The data are clouds of true scans of procedural objects, and clouds whose last scan is of a posterior sample, since
acquisitions give such clouds to the network. Clouds and network stay in the output folder, so that an interrupted run
continues. Takes half an hour on two CPU cores.
"""

import argparse
import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from training import fit
from training_clouds import LabelledClouds, Source, concatenated

from jaxnbv import Coverage, Grid, Planner
from jaxnbv.networks import CATEGORIES, CompactPartSegmenter, part_mask, save_checkpoint
from jaxnbv.networks.pretrained import TRAINED_SIDE
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.studies.sensors import PART_SETTING

WEIGHTS = Path(__file__).parents[1] / "jaxnbv" / "networks" / "weights" / "parts.safetensors"


def log_probabilities(network: CompactPartSegmenter, example: LabelledClouds):
    """log p of the parts at each point, very low for parts of other categories than the cloud's."""
    cloud = example.clouds
    log_p = network(cloud.points, cloud.normals, example.labels, cloud.mask)
    is_allowed = jnp.asarray(part_mask())[example.labels]
    return jax.nn.log_softmax(jnp.where(is_allowed, log_p, -1e9))


def loss(network: CompactPartSegmenter, example: LabelledClouds):
    """Mean of -log p(part) over the points that are not masked."""
    of_points = -jnp.take_along_axis(log_probabilities(network, example), example.point_labels[:, None], axis=1)[:, 0]
    mask = example.clouds.mask
    return jnp.sum(jnp.where(mask, of_points, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


@eqx.filter_jit
def predicted(network: CompactPartSegmenter, data: LabelledClouds):
    """The likeliest part at every point, and its probability."""

    def of_cloud(example):
        log_p = log_probabilities(network, example)
        return jnp.argmax(log_p, axis=1), jnp.exp(jnp.max(log_p, axis=1))

    return jax.lax.map(of_cloud, data)


def report(name: str, network: CompactPartSegmenter, data: LabelledClouds) -> None:
    """Print the accuracy over points, and the mean intersection over union of the parts of a category."""
    labels, confidence = (np.asarray(array) for array in predicted(network, jax.tree.map(jnp.asarray, data)))
    mask, is_right = data.clouds.mask, labels == data.point_labels
    print(f"{name}: {is_right[mask].mean():.1%} of points right, mean confidence {confidence[mask].mean():.1%}")
    for index in np.unique(data.labels):
        rows = data.labels == index
        is_filled, guess, true = mask[rows], labels[rows], data.point_labels[rows]
        ratios = []
        for part in CATEGORIES[index].labels:
            either = is_filled & ((guess == part) | (true == part))
            if either.any():
                ratios.append((either & (guess == true)).sum() / either.sum())
        accuracy = (guess == true)[is_filled].mean()
        text = ", ".join(f"{ratio:.2f}" for ratio in ratios)
        print(f"  {CATEGORIES[index].name:12} {accuracy:6.1%} of points, intersection over union {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/part-network"))
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    arguments = parser.parse_args()
    folder: Path = arguments.out
    sampler = dataclasses.replace(SurfaceSampler.preset(), grid=Grid(64), num_samples=4)
    planner = Planner(Coverage(), camera=PART_SETTING.camera, sampler=sampler, capacity=2500)
    source = Source(folder, part_scene, planner, setting=PART_SETTING, scale=2.0 / TRAINED_SIDE)

    clouds = concatenated(source.scanned(Split.TRAIN, 6000), source.imagined(Split.TRAIN, 130))
    network = CompactPartSegmenter(jax.random.key(0))
    network = fit(network, loss, clouds, jax.random.key(1), 3000, file=folder / "network.eqx")
    report("true scans, test split", network, source.scanned(Split.TEST, 900))
    report("imagined scans, validation split", network, source.imagined(Split.VALIDATION, 13))

    save_checkpoint(network, arguments.weights)
    print(f"{arguments.weights}   {arguments.weights.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
