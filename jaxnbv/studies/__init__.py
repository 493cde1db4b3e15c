"""The laboratory: scenes, the engine of studies, and one folder or file a study. The library imports none of it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=("scenes",))
