"""Procedural scenes, shipped as code."""

from jaxnbv.datasets.demo import demo_object as demo_object
