"""The harm of known shapes that do not include the object's class, or are all of another kind. These are methods for
the studies of classes, to compare with the study's own, whose bank has objects of all classes.

    cd benchmarks
    jaxnbv study pyramid --framing close-up --model known --views 2 --scenes 60 --methods cross-entropy \
        --method honesty:without_the_class --method honesty:another_kind --method honesty:no_shapes

All methods choose by cross-entropy. The other kind is trucks, or pyramids if the objects are trucks.
"""

import dataclasses

from jaxnbv import Planner, SurfaceSampler
from jaxnbv.studies.classification.study import ClassificationStudy
from jaxnbv.studies.engine.study import Scene
from jaxnbv.surfaces import KnownShapes
from jaxnbv.surfaces.known_shapes import kind_of
from jaxnbv.surfaces.shipped_banks import bank_poses, shape_bank


def without_the_class(study: ClassificationStudy, scene: Scene) -> Planner:
    """A planner whose bank has the study's objects of all classes but the scene's."""
    sampler = study.sampler
    assert isinstance(sampler.model, KnownShapes), "run the study by --model known"
    bank, class_name = sampler.model.bank, study.objects.classes[scene.task.label]
    others = [row for row, name in enumerate(bank.names) if kind_of(name) != class_name]
    return _planner(study, scene, sampler.without_bank.with_bank(bank.select(others), sampler.model.poses))


def another_kind(study: ClassificationStudy, scene: Scene) -> Planner:
    """A planner whose bank has only objects of another kind."""
    other = "pyramid" if study.bank == "truck" else "truck"
    return _planner(study, scene, study.sampler.without_bank.with_bank(shape_bank(other), bank_poses(other)))


def no_shapes(study: ClassificationStudy, scene: Scene) -> Planner:
    """A planner without a bank."""
    return _planner(study, scene, study.sampler.without_bank)


def _planner(study: ClassificationStudy, scene: Scene, sampler: SurfaceSampler) -> Planner:
    return dataclasses.replace(study, sampler=sampler).planner("cross-entropy", scene)
