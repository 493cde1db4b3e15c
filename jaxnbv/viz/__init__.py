"""Reports of episodes, figures, a live page, and pictures for notebooks."""

import lazy_loader

from jaxnbv.errors import explained_imports

_named, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__getattr__ = explained_imports()(_named)
