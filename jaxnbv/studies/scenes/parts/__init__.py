"""Procedural objects of ShapeNet-part's categories, labelled by its parts: random proportions, variants and extras."""

from jaxnbv.studies.scenes.parts.scenes import PART_CATEGORIES as PART_CATEGORIES
from jaxnbv.studies.scenes.parts.scenes import PartScene as PartScene
from jaxnbv.studies.scenes.parts.scenes import part_scene as part_scene
from jaxnbv.studies.scenes.parts.scenes import sample_part_object as sample_part_object
