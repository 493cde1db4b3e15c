"""Studies that compare methods, with scenes and an engine. The library itself imports none of them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=("scenes",))
