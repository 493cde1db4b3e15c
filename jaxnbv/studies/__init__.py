"""Studies that compare methods, their procedural scenes and their engine. The library imports none of it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=("scenes",))
