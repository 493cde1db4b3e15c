"""Errors that users can fix, and imports of optional dependencies."""

import difflib
import importlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

EXTRAS = {
    "igl": "meshes",
    "skimage": "meshes",
    "matplotlib": "report",
    "PIL": "report",
    "plotly": "report",
    "jinja2": "report",
    "distributed": "cluster",
    "loky": "heat",
    "robust_laplacian": "heat",
    "pandas": "studies",
    "threadpoolctl": "cluster",
    "viser": "view",
}
"""Name of the extra that installs each optional module."""


def install(extra: str) -> str:
    """Return the command that installs an extra from a clone (no release is on a package index yet)."""
    return f'pip install ".[{extra}]" in a clone of jaxnbv'


class InputError(ValueError):
    """Error for an input that cannot be used. The message names the value and the remedy."""


def suggestion(name: str, names: Iterable[str]) -> str:
    """Return " Did you mean ...?" with the most similar name, or an empty string if no name is similar."""
    by_lower = {candidate.lower(): candidate for candidate in names}
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1)
    return f" Did you mean {by_lower[matches[0]]!r}?" if matches else ""


@contextmanager
def explained_imports() -> Iterator[None]:
    """Context manager for imports of modules that need an extra (pip's optional dependencies).

    **Raises:** `ValueError` with the command that installs a missing extra.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = str(error.name).partition(".")[0]
        if missing not in EXTRAS:
            raise
        raise InputError(f"this needs {missing}: {install(EXTRAS[missing])}") from error


def optional(module: str) -> Any:
    """Import a module that an extra installs.

    **Raises:** `ValueError` with the command that installs the extra, if the module is missing.
    """
    with explained_imports():
        return importlib.import_module(module)
