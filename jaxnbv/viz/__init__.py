"""Pictures and words: the report of an episode, figures, a live page, and what a notebook shows."""

import lazy_loader

from jaxnbv.errors import explained_imports

_named, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = explained_imports()(_named)
