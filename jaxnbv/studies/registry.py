"""Registry of the studies of `jaxnbv study`.

Any installed package can register a study as an entry point of the group `jaxnbv.studies`. The entry point names an
`Entry`. Its module should not import JAX, because this would slow down the command's help.
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

    - `study`: class of the study as "module:class". It is imported when the study runs.
    - `question`: the question that the study answers, shown in the help.
    - `scenes`, `views`: default numbers of scenes and views.
    - `model`: default surface model: "known" (with known shapes), or the name of a model without known shapes.
    - `options`: typer annotations of the settings that only this study has. A setting with a `typer.Argument` must be
      given. The others default to None.
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
    """Return the studies of all installed packages by name.

    A study that cannot be loaded is left out, and a `UserWarning` names the study and the error.
    """
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
