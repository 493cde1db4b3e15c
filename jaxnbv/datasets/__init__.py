"""Procedural scenes, shipped as code, and readers of data sets."""

from jaxnbv.datasets.demo import demo_object as demo_object
from jaxnbv.datasets.heat_objects import HEAT_OBJECTS as HEAT_OBJECTS
from jaxnbv.datasets.heat_objects import HeatScene as HeatScene
from jaxnbv.datasets.heat_objects import heat_scene as heat_scene
from jaxnbv.datasets.heat_objects import source_view as source_view
from jaxnbv.datasets.labelled import LabelledSolid as LabelledSolid
from jaxnbv.datasets.parts import PART_CATEGORIES as PART_CATEGORIES
from jaxnbv.datasets.parts import PartScene as PartScene
from jaxnbv.datasets.parts import part_scene as part_scene
from jaxnbv.datasets.parts import sample_part_object as sample_part_object
from jaxnbv.datasets.patterns import PATTERNS as PATTERNS
from jaxnbv.datasets.pyramid import Framing as Framing
from jaxnbv.datasets.pyramid import Pyramid as Pyramid
from jaxnbv.datasets.pyramid import Split as Split
from jaxnbv.datasets.pyramid import hidden_view as hidden_view
from jaxnbv.datasets.pyramid import pyramid_scene as pyramid_scene
from jaxnbv.datasets.pyramid import sample_pyramid as sample_pyramid
from jaxnbv.datasets.shapenet_part import LabelledShape as LabelledShape
from jaxnbv.datasets.shapenet_part import ShapeNetPart as ShapeNetPart
from jaxnbv.datasets.shapenet_part import unit_sphere as unit_sphere
