"""Studies of the paper's claims: their scenes and readers, the engine that runs them, one folder or file a study."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=("readers", "scenes"))
