"""Procedural scenes: pyramids, trucks, household objects, objects with labelled parts, heated objects."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
