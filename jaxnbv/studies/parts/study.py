"""The study of semantic parts: how many views until all parts of an object are found? The paper's Table 1."""

import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.imagination import Imagination
from jaxnbv.networks import CATEGORIES, CloudSegmenter, part_segmenter
from jaxnbv.scanning import SDFSurface
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.parts.discovery import PartDiscoveryStudy
from jaxnbv.studies.parts.meshes import MeshPartStudy
from jaxnbv.studies.scenes import Split, part_scene
from jaxnbv.surfaces import KnownShapes
from jaxnbv.surfaces.known_shapes import kind_of


class PartStudy(PartDiscoveryStudy):
    """The parts of procedural objects by the shipped network. Settings as of `PartDiscoveryStudy`, and

    - `segmenter`: of clouds in scene coordinates; its category is replaced by that of each scene's object.
    - `split`: which scenes; tune on those of the validation split.
    """

    bank: ClassVar[str] = "parts"

    segmenter: CloudSegmenter = eqx.field(kw_only=True)
    split: Split = eqx.field(static=True, default=Split.TEST)

    @classmethod
    def configured(
        cls, model: str, views: int, quick: bool, meshes: str | Path | None = None, **options: Any
    ) -> dict[str, Study]:
        """With a folder of meshes, that of their parts.

        **Raises:** `ValueError` as `part_files` does.
        """
        if meshes is not None:
            return MeshPartStudy.configured(model, views, quick, meshes=meshes, **options)
        return super().configured(model, views, quick, segmenter=part_segmenter(category=0), **options)

    def scene(self, index: int) -> Scene:
        """An object; its task is the `PartScene`."""
        made = part_scene(self.split, index)
        return Scene(index, CATEGORIES[int(made.category)].name, SDFSurface(made.solid), made)

    def segmenter_of(self, scene: Scene, num_points: int | None = None) -> CloudSegmenter:
        """The network, told the object's category."""
        given = self.segmenter
        return CloudSegmenter(given.network, scene.task.category, num_points or given.num_points, given.scale)

    def imagination_of(self, scene: Scene) -> Imagination:
        """As the network's, with the shapes of the object's category."""
        model = self.imagination.model
        if not isinstance(model, KnownShapes):
            return self.imagination
        alike = [index for index, name in enumerate(model.bank.names) if kind_of(name) == scene.name]
        known = dataclasses.replace(model, bank=model.bank.chosen(alike))
        return dataclasses.replace(self.imagination, model=known)

    def true_parts(self, scene: Scene, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        return scene.task.solid.label(points)

    def truth(self, scene: Scene) -> list[int]:
        """The labels of the parts that the object has."""
        return [int(label) for label in np.flatnonzero(np.asarray(scene.task.parts))]

    def facts(self, scene: Scene, truth: list[int], first: int) -> Record:
        category = CATEGORIES[int(scene.task.category)]
        parts = [category.parts[label - category.first_label] for label in truth]
        return {"name": scene.name, "split": self.split.value, "category": category.name, "parts": parts}
