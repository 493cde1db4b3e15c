"""Studies that compare methods of choosing views, with their scenes and the engine that runs them.

Within the library, only the command line imports this package.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=("scenes",))
