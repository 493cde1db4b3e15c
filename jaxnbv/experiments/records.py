"""Results of a study on disk: one JSON record a scene, so that a study that was interrupted goes on with the next."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from jaxnbv.checks import InputError, require
from jaxnbv.files import write_whole
from jaxnbv.storage import differences, versions


class RecordFolder:
    """A folder of records that belong to one configuration, kept beside them in study.json.

    **Raises:** `ValueError` if the folder cannot be made or holds records of another configuration.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        self.path = Path(path)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot make the output folder {self.path} ({error}): choose another place") from error
        file = self.path / "study.json"
        if not file.exists():
            _write(file, {**config, "versions": versions()})
            return
        written = _read(file)
        made_by = written.pop("versions", None)
        changed = differences(written, json.loads(json.dumps(config)))
        require(
            not changed,
            f"the output folder {self.path} belongs to another study; it differs in {'; '.join(changed[:3])}. "
            "Choose another folder, or the settings it was made with",
        )
        if made_by != versions():
            warnings.warn(
                f"{self.path} was begun with other versions ({'; '.join(differences(made_by, versions()))}): "
                "new records may differ from those of an uninterrupted study",
                stacklevel=2,
            )

    def collect(self, count: int, run: Callable[[int], dict[str, Any]], progress: bool = True) -> list[dict[str, Any]]:
        """Records 0 to `count` - 1: those on disk as they are, the others from `run`, each written once it is done."""
        records = []
        for index in tqdm(range(count), desc=self.path.name, unit="scene", disable=not progress):
            file = self.path / f"scene_{index:04d}.json"
            if not file.exists():
                _write(file, run(index))
            records.append(_read(file))
        return records


def _write(file: Path, content: dict[str, Any]) -> None:
    write_whole(file, lambda out: out.write(json.dumps(content).encode()))


def _read(file: Path) -> Any:
    try:
        return json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{file} is damaged ({error}): delete it, and it is made again") from error
