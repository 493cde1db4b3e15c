"""Results of a study on disk. One JSON file per scene lets an interrupted study continue."""

import hashlib
import json
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.progress import progress_bar
from jaxnbv.storage.files import write_text
from jaxnbv.storage.folders import ResultFolder, check_format, differences, read_json, read_record, versions
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.trials import Failure, Trial, outcomes

_FAILURE_SUFFIX = ".failed"
_FORMAT = 2
_NO_ARRAYS: Mapping[str, np.ndarray] = MappingProxyType({})


class RecordFolder(ResultFolder):
    """A folder with one record per scene of a study. study.json holds their common configuration.

    - `config`, `arrays`: the configuration as JSON, and its large arrays, see `jaxnbv.storage.describe`.
    - `executor`: an executor with the interface of `concurrent.futures`, such as `Processes(8)` or a `Cluster`, that
      runs the scenes; default: this process runs them. In both cases, this process writes the records.

    **Raises:** `ValueError` if the folder cannot be made, or if it holds records of a different configuration.
    """

    kind, pattern, format, is_shared = "study", "scene_*.json", _FORMAT, True

    def __init__(
        self,
        path: str | Path,
        config: dict[str, Any],
        executor: Executor | None = None,
        arrays: Mapping[str, np.ndarray] = _NO_ARRAYS,
    ):
        self.executor = executor
        super().__init__(path, config, arrays)

    def collect(self, scenes: Sequence[int], run: Trial, progress: bool = True) -> list[Record]:
        """Run the scenes that have no record yet, and return the records of all `scenes` in order of index.

        `run` takes the index of a scene and returns its record, which is written at once. If `run` fails for a scene,
        the scene has no record, `failures` returns the error, and the next call of `collect` runs the scene again.

        **Raises:** `ValueError` if a record is damaged, or if another process is writing in the folder.
        """
        with self.writing():
            records = {index: _read(self._file(index), index) for index in scenes if self._file(index).exists()}
            missing = [index for index in scenes if index not in records]
            if missing:
                self.set_versions(versions() if self.executor is None else self.executor.submit(versions).result())
            bar = progress_bar(None, progress, True, total=len(scenes), initial=len(records), desc=self.path.name)
            with bar, closing(outcomes(run, missing, self.executor)) as pairs:
                for index, outcome in pairs:
                    if isinstance(outcome, Failure):
                        file = self._file(index).with_suffix(_FAILURE_SUFFIX)
                        write_text(file, f"{outcome.error}\n\n{outcome.traceback}")
                    else:
                        records[index] = self._write(index, outcome)
                    bar.update()
                    if progress and bar.disable:
                        print(f"{self.path.name}: scene {index} is done", file=sys.stderr, flush=True)
        return [records[index] for index in sorted(records)]

    def join(self, folders: Iterable[str | Path]) -> None:
        """Copy the records of other folders into this folder.

        **Raises:** `ValueError` in these cases:

        - a folder holds no study, a study with a different configuration, or a damaged record;
        - two folders hold the same scene, and the results differ in more than their times.
        """
        with self.writing():
            for folder in map(Path, folders):
                self._join(folder)

    def _join(self, folder: Path) -> None:
        record = read_record(folder, self.kind, "leave it out")
        check_format(record.get("format"), _FORMAT, folder / f"{self.kind}.json")
        changes = differences(record["config"], self.config)
        require(
            not changes,
            f"{folder} has other settings than {self.path}; it differs in {'; '.join(changes[:3])}: leave it out, or "
            "join folders of the same command",
        )
        self.set_versions(record.get("versions", {}))
        for index, file in _files(folder):
            other, target = _read(file, index), self._file(index)
            if not target.exists():
                self._write(index, other)
            elif changes := differences(_without_seconds(other), _without_seconds(_read(target, index))):
                problem = f"{file} and {target} differ in {'; '.join(changes[:3])}"
                raise InputError(f"{problem}: delete the one that is wrong")

    def failures(self, scenes: Sequence[int]) -> dict[int, str]:
        """Return the error of each failed scene in one line. Tracebacks are in the files scene_*.failed."""
        files = {index: self._file(index).with_suffix(_FAILURE_SUFFIX) for index in scenes}
        return {index: file.read_text().partition("\n")[0] for index, file in files.items() if os.path.isfile(file)}

    def _file(self, index: int) -> Path:
        return self.path / f"scene_{index:04d}.json"

    def _write(self, index: int, record: Record) -> Record:
        """Write a record, and return it as `_read` would."""
        # JSON turns keys that are numbers into text, which sorts differently. So convert them before the checksum.
        record = json.loads(json.dumps(record))
        self.bind()
        content = {"format": _FORMAT, "index": index, "sha256": _checksum(index, record), "record": record}
        write_text(self._file(index), json.dumps(content))
        self._file(index).with_suffix(_FAILURE_SUFFIX).unlink(missing_ok=True)
        return record


def read_records(folder: str | Path) -> list[Record]:
    """Read all records of a folder, in the order of their files' names.

    **Raises:** `ValueError` if a record is damaged, or if a file scene_*.json has no scene number in its name.
    """
    return [_read(file, index) for index, file in _files(Path(folder))]


def _files(folder: Path) -> list[tuple[int, Path]]:
    files = []
    for file in sorted(folder.glob(RecordFolder.pattern)):
        number = file.stem.removeprefix("scene_")
        require(number.isdecimal(), f"{file} is not a record, since its name has no scene number: move it elsewhere")
        files.append((int(number), file))
    return files


def _without_seconds(content: Any) -> Any:
    """Return a copy of nested lists and dicts without the entries named "seconds"."""
    if isinstance(content, list):
        return [_without_seconds(item) for item in content]
    if isinstance(content, dict):
        return {key: _without_seconds(value) for key, value in content.items() if key != "seconds"}
    return content


def _checksum(index: int, record: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps([_FORMAT, index, record], sort_keys=True).encode()).hexdigest()


def _read(file: Path, index: int) -> dict[str, Any]:
    """Read the record of scene `index`, and check its format, index and checksum."""
    remedy = "delete it, and run the study again"
    content = read_json(file, "is damaged", remedy)
    check_format(content.get("format"), _FORMAT, file)
    require(content.get("index") == index, f"{file} is damaged (it is scene {content.get('index')!s:.20}): {remedy}")
    record = content.get("record")
    if not isinstance(record, dict) or content.get("sha256") != _checksum(index, record):
        raise InputError(f"{file} is damaged (its checksum does not match its record): {remedy}")
    return record
