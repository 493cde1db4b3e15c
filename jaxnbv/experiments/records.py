"""Results of a study on disk: one JSON record a scene, so that a study that was interrupted goes on with the next."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from jaxnbv.checks import InputError, require
from jaxnbv.files import write_text
from jaxnbv.folders import FORMAT, ResultFolder, check_format, read_json


class RecordFolder(ResultFolder):
    """A folder of records that belong to one configuration, kept beside them in study.json.

    **Raises:** `ValueError` if the folder cannot be made or holds records of another configuration.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        super().__init__(path, "study.json", "scene_*.json", config, "study")

    def collect(self, count: int, run: Callable[[int], dict[str, Any]], progress: bool = True) -> list[dict[str, Any]]:
        """Records 0 to `count` - 1: those on disk as they are, the others from `run`, each written once it is done.

        **Raises:** `ValueError` for a record that is damaged, and if another process writes in the folder.
        """
        records = []
        with self.writing():
            for index in tqdm(range(count), desc=self.path.name, unit="scene", disable=not progress):
                file = self.path / f"scene_{index:04d}.json"
                if not file.exists():
                    # As it will be read: JSON turns keys that are numbers into text, and the checksum sorts them.
                    record = json.loads(json.dumps(run(index)))
                    self.bind()
                    sealed = {"format": FORMAT, "index": index, "sha256": _checksum(index, record), "record": record}
                    write_text(file, json.dumps(sealed))
                records.append(_read(file, index))
        return records


def _checksum(index: int, record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps([FORMAT, index, record], sort_keys=True).encode()).hexdigest()


def _read(file: Path, index: int) -> dict[str, Any]:
    """A record; those of format 1 stand in their files as they are."""
    remedy = "delete it, and it is made again"
    content = read_json(file, "is damaged", remedy)
    if "format" not in content:
        return content
    check_format(content["format"], file)
    require(content.get("index") == index, f"{file} is damaged (it is scene {content.get('index')!s:.20}): {remedy}")
    record = content.get("record")
    if not isinstance(record, dict) or content.get("sha256") != _checksum(index, record):
        raise InputError(f"{file} is damaged (its checksum is not that of its record): {remedy}")
    return record
