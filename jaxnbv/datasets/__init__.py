"""Procedural scenes, shipped as code."""

from jaxnbv.datasets.demo import demo_object as demo_object
from jaxnbv.datasets.patterns import PATTERNS as PATTERNS
from jaxnbv.datasets.pyramid import Framing as Framing
from jaxnbv.datasets.pyramid import Pyramid as Pyramid
from jaxnbv.datasets.pyramid import Split as Split
from jaxnbv.datasets.pyramid import hidden_view as hidden_view
from jaxnbv.datasets.pyramid import pyramid_scene as pyramid_scene
from jaxnbv.datasets.pyramid import sample_pyramid as sample_pyramid
