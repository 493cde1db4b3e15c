"""Registry of the studies of `jaxnbv study`.

Studies are entry points of the group `jaxnbv.studies` in any installed package. Each entry point names an `Entry` in a
module that does not import JAX, so that the command's help shows quickly.
"""

import functools
import pkgutil
import warnings
from collections.abc import Mapping
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Any, NamedTuple

GROUP = "jaxnbv.studies"


class Entry(NamedTuple):
    """Describes one study to the command line.

    - `study`: its class as "module:class", imported when the study runs.
    - `question`: the question that it answers, shown in the help.
    - `scenes`, `views`: default numbers of scenes and views.
    - `model`: default model of surfaces; "known" for a study that has a `bank` or is about known parts.
    - `options`: typer annotations of the study's own options, by the names of its settings. Their default is None. A
      `typer.Argument` is required. Options that all studies have, such as `capacity`, are left out.
    """

    study: str
    question: str
    scenes: int
    views: int
    model: str = "screened"
    options: Mapping[str, Any] = MappingProxyType({})

    def load(self) -> Any:
        """Import and return the class of the study."""
        return pkgutil.resolve_name(self.study)


@functools.cache
def studies() -> dict[str, Entry]:
    """The studies of all installed packages, by name. A `UserWarning` names each that cannot be loaded."""
    entries: dict[str, Entry] = {}
    for point in entry_points(group=GROUP):
        try:
            entry = point.load()
        # A module of another package may raise anything on import.
        except (Exception, SystemExit) as error:
            warnings.warn(f"the study {point.name} is left out: {point.value} fails ({error!r})", stacklevel=2)
            continue
        if isinstance(entry, Entry):
            entries.setdefault(point.name, entry)
        else:
            warnings.warn(f"the study {point.name} is left out: {point.value} is no Entry", stacklevel=2)
    return entries
