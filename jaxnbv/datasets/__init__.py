"""Procedural scenes, shipped as code, and readers of data sets: the names of `__init__.pyi`, lazily imported."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
