"""jaxnbv: task-specific next-best-view selection with uncertain geometry, in differentiable JAX.

`__init__.pyi` lists the public names. Each name is imported at its first use, because JAX takes seconds to import.
"""

import importlib.metadata
import sys
from typing import Any

import lazy_loader

from jaxnbv.errors import explained_imports, suggestion
from jaxnbv.version import check_jax

check_jax(importlib.metadata.version("jaxlib"))

_load_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        problem = f"module {__name__!r} has no attribute {name!r}."
        # `obj=None` stops Python from appending a suggestion of its own.
        raise AttributeError(f"{problem}{suggestion(name, __all__)}", name=name, obj=None)
    with explained_imports():
        return _load_name(name)


# Classes that notebooks show as a small picture with a line of facts.
_NOTEBOOK_CLASSES = {
    "jaxnbv.geometry.cloud": "PointCloud",
    "jaxnbv.planning.episode": "Episode",
    "jaxnbv.planning.planner": "Planner",
    "jaxnbv.planning.session": "Session",
    "jaxnbv.observations": "Observations",
    "jaxnbv.search.proposal": "Proposal",
    "jaxnbv.surfaces.base": "SurfacePosterior",
}


def _html_of(value: Any) -> str:
    from jaxnbv.viz.notebook import html_of

    return html_of(value)


def _show_in_notebooks() -> None:
    """If IPython is running, let it show `_NOTEBOOK_CLASSES` as HTML. This imports none of their modules."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    if shell is not None:
        for module, name in _NOTEBOOK_CLASSES.items():
            shell.display_formatter.formatters["text/html"].for_type_by_name(module, name, _html_of)


_show_in_notebooks()
