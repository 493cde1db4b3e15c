"""What the commands do. Their modules import JAX and much else, so each is imported when a command first uses it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
