"""Errors that users can mend."""

import importlib
from collections.abc import Iterator
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
"""Which extra brings what a part of the package needs beyond the dependencies that all of it has."""


def install(extra: str) -> str:
    """The command that installs an extra: from a clone, for there is no release on a package index yet."""
    return f'pip install ".[{extra}]" in a clone of jaxnbv'


class InputError(ValueError):
    """Something that the user gave cannot be used; the message says what, and what to do."""


@contextmanager
def explained_imports() -> Iterator[None]:
    """Where parts of the package are imported that need an extra.

    **Raises:** `ValueError` that says how to install one that is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = str(error.name).partition(".")[0]
        if missing not in EXTRAS:
            raise
        raise InputError(f"this needs {missing}: {install(EXTRAS[missing])}") from error


def optional(module: str) -> Any:
    """A module of an extra.

    **Raises:** `ValueError` that says how to install it, if it is missing.
    """
    with explained_imports():
        return importlib.import_module(module)
