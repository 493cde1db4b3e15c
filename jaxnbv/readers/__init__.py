"""Readers of local copies of data sets: recorded depth sequences, and folders of meshes sorted by class."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
