"""What shows itself in a notebook. The pictures are drawn by `jaxnbv.viz`, which is imported when one is wanted."""

import importlib

import equinox as eqx


class Displayed(eqx.Module):
    """A module that a notebook shows by a small picture and a line of facts."""

    def _repr_html_(self) -> str:
        return importlib.import_module("jaxnbv.viz.notebook").html_of(self)
