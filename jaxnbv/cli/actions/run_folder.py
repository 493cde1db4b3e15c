"""The folder of a run: its usual name, what was asked for in it, and how it is begun anew."""

import json
import re
from pathlib import Path
from typing import Any

from jaxnbv.checks import require
from jaxnbv.storage import remove_episode
from jaxnbv.storage.files import write_text
from jaxnbv.storage.folders import AnotherConfigurationError, read_json, remove_empty, writing_in

_OPTIONS, _FIGURES = "options.json", "figures"


def usual_folder(name: str, task: str, search: str, model: str, seed: int) -> Path:
    """runs/NAME-TASK-SEARCH[-MODEL]-seedN."""
    parts = name, task, search, *(() if model == "screened" else (model,)), f"seed{seed}"
    return Path("runs") / re.sub(r"[^A-Za-z0-9_.-]", "_", "-".join(parts))


def clear(folder: Path, *inside: str) -> None:
    """Remove an episode, its report, and what was asked for, and with it the episodes in folders of some names inside;
    a folder of something else is left as it is.

    **Raises:** `ValueError` if another process writes there, or if something else lies among the report's figures;
    nothing is removed there then.
    """
    for name in inside:
        clear(folder / name)
        remove_empty(folder / name)
    figures = folder / _FIGURES
    others = sorted(file.name for file in figures.glob("*") if file.suffix != ".png")
    require(not others, f"{figures} holds {', '.join(others)}, which is of no report: move it, or give another --out")
    if remove_episode(folder):
        with writing_in(folder):
            for pattern in (_OPTIONS, "report.html", f"{_FIGURES}/*.png"):
                for file in folder.glob(pattern):
                    file.unlink()
            if figures.is_dir() and not any(figures.iterdir()):
                figures.rmdir()


def note(folder: Path, asked: dict[str, Any]) -> None:
    """Write down what was asked for, in the user's own words."""
    write_text(folder / _OPTIONS, json.dumps(asked, indent=2))


def explained(folder: Path, asked: dict[str, Any], error: AnotherConfigurationError) -> str:
    """Why a folder belongs to another episode: the options that differ, if they are known, else what the error says."""
    changed: list[str] = []
    if (folder / _OPTIONS).exists():
        held = read_json(folder / _OPTIONS, "does not hold options", "give another --out, or --overwrite")
        both = {name: (held.get(name), asked.get(name)) for name in [*held, *asked]}
        changed = [_difference(name, there, now) for name, (there, now) in both.items() if there != now]
    if not changed:
        return f"{error}; or replace it by --overwrite"
    return (
        f"the output folder {folder} belongs to another episode: {'; '.join(changed)}. Give the options it was made "
        "with, another --out, or --overwrite to replace it"
    )


def _difference(name: str, there: Any, now: Any) -> str:
    if name == "mesh":
        return f"the mesh {there} there, {now} now"
    if isinstance(there, bool) or isinstance(now, bool):
        return f"--{name} there, not now" if there else f"--{name} now, not there"
    there, now = ("not given" if value is None else value for value in (there, now))
    return f"--{name} {there} there, {now} now"
