"""The class of an object from known shapes of all classes, without a network.

    python benchmarks/classes.py --meshes FOLDER [--scenes 16] [--views 3] [--out runs/classes]

The folder has a folder of meshes for each class. The bank holds all other meshes, upright, with equal longest sides.
`Identify(group=...)` asks for the class. *Class right*: the class with the most weight among the bank's objects is the
true one. *Network*: the shipped classifier of household objects names the true class, among the classes that it knows.
"""

import argparse
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.acquisition import Acquisition
from jaxnbv.geometry.frame import Frame
from jaxnbv.networks import pretrained_classifier
from jaxnbv.planning.loop import Sensor, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.readers import MeshFile, class_meshes
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import TriangleMesh
from jaxnbv.studies.engine.measures import Measure, Record
from jaxnbv.studies.engine.records import RecordFolder
from jaxnbv.studies.engine.results import results, summary
from jaxnbv.studies.engine.run import run_scene
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.identification import IDENTIFY
from jaxnbv.studies.scenes.household import HOUSEHOLD
from jaxnbv.surfaces import Upright

# The longest side of an object in scene units. The object fits into the box at any angle about the vertical.
_SIDE = 1.6
_ORDER_SEED = 7


@functools.cache
def objects_in(files: tuple[MeshFile, ...]) -> tuple[nbv.ShapeBank, tuple[str, ...], list[trimesh.Trimesh]]:
    """A bank of the meshes at equal sizes, the class of each, and the meshes themselves."""
    meshes, names = [], []
    for number, file in enumerate(files):
        mesh = file.read()
        meshes.append(trimesh.Trimesh(_SIDE / 2.5 * mesh.vertices, mesh.faces, process=False))
        names.append(f"{number} {file.name}")
    bank = nbv.ShapeBank.from_meshes(meshes, names=names, scale=1.0)
    indices = [int(name.split()[0]) for name in bank.names]
    return bank, tuple(Path(files[index].path).parent.name for index in indices), [meshes[index] for index in indices]


def _by_view(name: str) -> Any:
    return lambda record, method: [float(value) for value in record["methods"][method][name]]


class ClassStudy(Study):
    """The class of an object that is not in the bank."""

    title: ClassVar[str] = "The class of an object, by the others alone"
    explanation: ClassVar[str] = "Class right: the class of most weight is the true one."
    methods: ClassVar[tuple[str, ...]] = (IDENTIFY, "new-surface", "farthest", "random")
    reference: ClassVar[str] = IDENTIFY
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure("right", "Class right", _by_view("right"), unit="%"),
        Measure("probability", "Probability of the true class", _by_view("probability"), digits=2),
        Measure("network", "The network's class right", _by_view("network"), unit="%"),
    )
    seed: ClassVar[int] = 23
    radius: ClassVar[float] = 4.0

    @functools.cached_property
    def order(self) -> np.ndarray:
        """Random order of the objects, since the files list one of each class in turn."""
        return np.random.default_rng(_ORDER_SEED).permutation(len(objects_in(self.meshes)[2]))

    def scene(self, index: int) -> Scene:
        """An upright object. The task of the scene is its number in the bank."""
        (bank, _, meshes), number = objects_in(self.meshes), int(self.order[index])
        angle = np.random.default_rng(1000 + index).uniform(0.0, 2.0 * np.pi)
        rotation = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        vertices = np.asarray(meshes[number].vertices) @ rotation.T
        mesh = TriangleMesh(vertices.astype(np.float32), np.asarray(meshes[number].faces, np.int32), Frame())
        return Scene(index, bank.names[number], mesh, number)

    def sensor(self, scene: Scene) -> Sensor:
        noise = nbv.SensorNoise(0.006 * _SIDE, 0.1)
        return lambda pose, key: observe_scene(scene.surface, self.camera, pose, noise, key, None)

    @property
    def candidates(self) -> nbv.SphereCandidates:
        return nbv.SphereCandidates(self.num_candidates, self.radius, 0.15)

    @property
    def imagined_camera(self) -> nbv.Camera:
        return self.camera.resized(28, 28)

    def others(self, scene: Scene) -> list[int]:
        return [index for index in range(len(objects_in(self.meshes)[0])) if index != scene.task]

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        return self.sampler.with_bank(objects_in(self.meshes)[0].select(self.others(scene)), Upright())

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        kinds = np.array(objects_in(self.meshes)[1])[self.others(scene)]
        return nbv.Identify(group=kinds.tolist()) if method == IDENTIFY else nbv.NewSurface()

    def follow(self, scene: Scene, truth: Any, planner: Planner, episode: Iterator[Step]) -> Record:
        """Record after each view whether the class is right, by the hypotheses and by the network."""
        kinds = np.array(objects_in(self.meshes)[1])
        true_class, others = kinds[scene.task], kinds[self.others(scene)]
        network = pretrained_classifier("household", _SIDE)
        measures: Mapping[str, list[float]] = {"right": [], "probability": [], "network": []}
        for step in episode:
            weights = np.asarray(step.observations.hypotheses.shape_weights, np.float64)
            weight_of_class = {kind: weights[others == kind].sum() / max(weights.sum(), 1e-30) for kind in set(others)}
            measures["right"].append(float(max(weight_of_class, key=lambda kind: weight_of_class[kind]) == true_class))
            measures["probability"].append(float(weight_of_class[true_class]))
            prediction = HOUSEHOLD[int(np.argmax(network(step.observations.cloud)))].replace(" ", "_")
            measures["network"].append(
                float(prediction == true_class) if true_class.replace("_", " ") in HOUSEHOLD else np.nan
            )
        return dict(measures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", required=True, type=Path)
    for name, default in {"scenes": 16, "views": 3}.items():
        parser.add_argument(f"--{name}", default=default, type=int)
    parser.add_argument("--out", default="runs/classes", type=Path)
    options = parser.parse_args()
    folders = sorted(path.name for path in options.meshes.iterdir() if path.is_dir())
    files = class_meshes(options.meshes, folders)
    sampler = SurfaceSampler.preset("screened")
    study = ClassStudy(views=options.views, sampler=sampler, meshes=files, capacity=2000, num_samples=8)
    records = RecordFolder(options.out, {"folder": str(options.meshes), "views": options.views}).collect(
        range(options.scenes), functools.partial(run_scene, study)
    )
    print(summary(results(records, ClassStudy), ClassStudy))


if __name__ == "__main__":
    main()
