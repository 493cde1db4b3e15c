"""Pictures and words: the report of an episode, figures, a live page, and what a notebook shows."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
