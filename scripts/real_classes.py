"""Accuracy of the shipped classifier of household objects on real ones, as shipped and tuned on a few of them.

    python scripts/real_classes.py FOLDER [--few 2] [--steps 300] [--out results.json]

FOLDER has a folder of meshes for each class, as for `jaxnbv study household --meshes`. The first `few` objects of each
class that has more tune the network, together with procedural objects so that it does not forget these. The other
objects test it, with ten clouds each, of five random views with the sensor's noise. Accuracy is the mean over objects,
with its standard error over objects.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from training import log_probabilities, train
from training_clouds import joined_views, random_poses, scanned_clouds

from jaxnbv import Camera, PointCloud
from jaxnbv.geometry.cloud import farthest_point_subsample
from jaxnbv.networks import pretrained_classifier
from jaxnbv.networks.pretrained import TRAINED_POINTS
from jaxnbv.readers import MeshFile, class_meshes
from jaxnbv.scanning import SensorNoise, scan
from jaxnbv.scanning.sensors import SENSOR_RADIUS
from jaxnbv.storage.folders import versions
from jaxnbv.studies.scenes import HOUSEHOLD, Split, household_scene

CLOUDS, VIEWS, STAND_INS = 10, 5, 200


def clouds_of(file: MeshFile, number: int, points: int) -> PointCloud:
    """Clouds of an object, each from different random views."""
    mesh = file.read()
    clouds = []
    for key in jax.random.split(jax.random.fold_in(jax.random.key(0), number), CLOUDS):
        place_key, noise_key = jax.random.split(key)
        poses = random_poses(place_key, VIEWS, SENSOR_RADIUS)
        cloud = SensorNoise()(scan(mesh, Camera(), poses), noise_key)
        clouds.append(farthest_point_subsample(joined_views(cloud), points))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)


def accuracy(network, objects: list[tuple[MeshFile, PointCloud]], names: tuple[str, ...]) -> dict:
    """Share of an object's clouds that the network classifies correctly: mean and standard error over objects."""
    fractions = {
        f"{names[file.label]} {file.name}": float(np.mean(log_probabilities(network, clouds).argmax(1) == file.label))
        for file, clouds in objects
    }
    values = np.array(list(fractions.values()))
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
    return {"objects": len(values), "right": float(values.mean()), "error": error, "by_object": fractions}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--few", type=int, default=2)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()

    names, points = HOUSEHOLD, TRAINED_POINTS["household"]
    files = class_meshes(arguments.folder, names)
    objects = [(file, clouds_of(file, number, points)) for number, file in enumerate(files)]
    few: list[tuple[MeshFile, PointCloud]] = []
    rest: list[tuple[MeshFile, PointCloud]] = []
    for label in sorted({file.label for file in files}):
        of_class = [one for one in objects if one[0].label == label]
        count = min(arguments.few, len(of_class) - 1)
        few, rest = few + of_class[:count], rest + of_class[count:]

    network = pretrained_classifier("household").network
    results = {"versions": versions(), "tuned_on": [f"{names[f.label]} {f.name}" for f, _ in few]}
    results["as it is"] = accuracy(network, rest, names)
    if few:
        procedural = scanned_clouds(household_scene, Split.TRAIN, range(STAND_INS), points)
        clouds = jax.tree.map(
            lambda *leaves: np.concatenate(leaves),
            PointCloud(procedural.clouds.points, procedural.clouds.normals, procedural.clouds.mask),
            *(PointCloud(cloud.points, cloud.normals, cloud.mask) for _, cloud in few),
        )
        labels = np.concatenate([procedural.labels, *(np.full(CLOUDS, file.label) for file, _ in few)])
        tuned = train(network, clouds, labels, jax.random.key(1), arguments.steps, learning_rate=3e-4)
        results["tuned"] = accuracy(tuned, rest, names)
    print(f"tuned on: {', '.join(results['tuned_on']) or 'none'}")
    for observations in ("as it is", "tuned"):
        if observations in results:
            scores = results[observations]
            error = "" if scores["error"] is None else f" ± {scores['error']:.0%}"
            print(f"{observations}: {scores['right']:.0%}{error} right of {scores['objects']} objects")
            for name, share in scores["by_object"].items():
                print(f"    {share:4.0%}  {name}")
    if arguments.out:
        arguments.out.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
