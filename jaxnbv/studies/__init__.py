"""Studies that compare methods, their scenes, and the engine that runs them.

Only the command line imports this package. The rest of the library does not.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=("scenes",))
