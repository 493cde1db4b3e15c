"""The tasks of `jaxnbv demo` and `jaxnbv run`: every `Task` with a name that a file of this folder defines."""

import importlib
import pkgutil

from jaxnbv.cli.tasks.base import Task


def _tasks() -> dict[str, type[Task]]:
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    defined = [kind for module in modules for kind in vars(module).values() if isinstance(kind, type)]
    return {kind.name: kind for kind in defined if issubclass(kind, Task) and "name" in vars(kind)}


TASKS = _tasks()
