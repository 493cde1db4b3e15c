"""The studies of `jaxnbv study`: entry points of the group `jaxnbv.studies` in any installed package.

Each names an `Entry` in a module that imports nothing heavy: the command's help needs it before JAX is imported.
"""

import functools
import pkgutil
import warnings
from collections.abc import Mapping
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any, NamedTuple, get_args

from typer.models import ArgumentInfo

GROUP = "jaxnbv.studies"


class Entry(NamedTuple):
    """One study, as its command must know it.

    - `study`: its class, "module:class", imported once it is run.
    - `question`: for the help.
    - `scenes`, `views`: numbers by default.
    - `model`: by which surfaces are imagined by default; "known" for a study that has a `bank`, or is
      about known parts.
    - `options`: annotations for typer of its own options, by the names of its settings; None is their default. One that
      is a `typer.Argument` must be given.
    """

    study: str
    question: str
    scenes: int
    views: int
    model: str = "screened"
    options: Mapping[str, Any] = MappingProxyType({})

    def load(self) -> Any:
        """The class of the study."""
        return pkgutil.resolve_name(self.study)

    @property
    def arguments(self) -> tuple[str, ...]:
        """Those of the options that must be given."""
        return tuple(name for name, hint in self.options.items() if isinstance(get_args(hint)[-1], ArgumentInfo))

    def flag(self, option: str) -> str:
        """How an option is given on the command line."""
        return option.upper() if option in self.arguments else f"--{option.replace('_', '-')}"


@functools.cache
def studies() -> dict[str, Entry]:
    """The studies of all installed packages, by name. A `UserWarning` names one that cannot be loaded."""
    entries: dict[str, Entry] = {}
    for point in entry_points(group=GROUP):
        try:
            entry = point.load()
        # Whatever a module of somebody else does as it is imported.
        except (Exception, SystemExit) as error:
            warnings.warn(f"the study {point.name} is left out: {point.value} fails ({error!r})", stacklevel=2)
            continue
        if isinstance(entry, Entry):
            entries.setdefault(point.name, entry)
        else:
            warnings.warn(f"the study {point.name} is left out: {point.value} is no Entry", stacklevel=2)
    return entries
