"""jaxnbv: task-specific next-best-view selection with uncertain geometry, in differentiable JAX.

The public names are those of `__init__.pyi`. Each is imported when it is first used, for JAX takes seconds to import.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
