"""The tasks of `jaxnbv demo` and `jaxnbv run`: all subclasses of `Task` in this folder that have a `name`."""

import importlib
import pkgutil

from jaxnbv.cli.tasks.base import Task


def _tasks() -> dict[str, type[Task]]:
    modules = [importlib.import_module(f"{__name__}.{module.name}") for module in pkgutil.iter_modules(__path__)]
    classes = [kind for module in modules for kind in vars(module).values() if isinstance(kind, type)]
    return {kind.name: kind for kind in classes if issubclass(kind, Task) and "name" in vars(kind)}


TASKS = _tasks()
