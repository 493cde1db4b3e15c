"""Local copies of data sets: what of them is missing or damaged is named, file by file."""

import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import InputError, require, shown
from jaxnbv.storage.files import is_file, is_folder

_MOST_NAMED = 3


def checked_folder(folder: str | Path) -> Path:
    """**Raises:** `ValueError` if there is no such folder."""
    require(is_folder(Path(folder)), f"there is no folder {folder}: give the place of the unpacked data set")
    return Path(folder)


def as_names(names: str | Iterable[str], what: str) -> tuple[str, ...]:
    """One name, or several without their repetitions.

    **Raises:** `ValueError` unless it is text, and for none at all.
    """
    problem = f"the {what} is {shown(names)}: give its name, or several"
    try:
        given = (names,) if isinstance(names, str) else tuple(names)
    except (TypeError, ValueError) as error:
        raise InputError(problem) from error
    require(len(given) > 0, f"no {what} is chosen: name at least one")
    require(all(isinstance(name, str) for name in given), problem)
    return tuple(dict.fromkeys(given))


def class_name(name: str) -> str:
    """Of a folder or a class, however it is written: "Night_Stand" is the "night stand"."""
    return name.lower().replace("_", " ")


def class_folders(folder: Path) -> dict[str, Path]:
    """The folders in a folder, by their `class_name`, in order."""
    return {class_name(path.name): path for path in sorted(folder.iterdir()) if path.is_dir()}


def chosen_folders(folder: Path, classes: Iterable[str]) -> dict[str, Path]:
    """Those of the `class_folders` that belong to the classes, in the order of these.

    **Raises:** `ValueError` if one is not there.
    """
    there = class_folders(folder)
    names = [class_name(name) for name in classes]
    absent = [name.replace(" ", "_") for name in names if name not in there]
    require(
        not absent,
        f"{folder} has no folder for {len(absent)} of the {len(names)} classes: {first(absent)}; unpack the data set "
        "again, or choose the classes that are there",
    )
    return {name: there[name] for name in names}


def present(files: Sequence[Path], what: str) -> list[Path]:
    """Those of the files that are there; of the others a `UserWarning` tells how many, and the first.

    **Raises:** `ValueError` if none is there.
    """
    require(len(files) > 0, f"there are no {what}: unpack the data set again")
    there = [file for file in files if is_file(file)]
    absent = sorted(set(files) - set(there))
    require(len(there) > 0, f"none of the {len(files)} {what} is there: {first(absent)}; unpack the data set again")
    if absent:
        warnings.warn(
            f"{len(absent)} of the {len(files)} {what} are not there and are left out: {first(absent)}; unpack the "
            "data set again if you want them",
            stacklevel=3,
        )
    return there


def check_listed(files: Sequence[Path], list_file: Path) -> None:
    """**Raises:** `ValueError` unless all files that a list names are there: how many are not, and the first."""
    absent = [file for file in files if not is_file(file)]
    require(
        not absent,
        f"{len(absent)} of the {len(files)} files that {list_file} names are not there: {first(absent)}; unpack the "
        "data set again",
    )


def check_file(path: Path) -> None:
    """**Raises:** `ValueError` if there is no such file."""
    require(is_file(path), f"there is no file {path}: the folder is incomplete, unpack the data set again")


def read_text(path: Path) -> str:
    """**Raises:** `ValueError` if the file is missing or is no text."""
    check_file(path)
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}): unpack the data set again") from error


def read_lines(path: Path) -> list[str]:
    """The lines of a list, without empty ones.

    **Raises:** `ValueError` as `read_text`, or if it lists nothing.
    """
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    require(len(lines) > 0, f"{path} lists nothing: unpack the data set again")
    return lines


def read_rows(path: Path, columns: str, delimiter: str | None = None) -> Float[np.ndarray, "rows columns"]:
    """The numbers in a text file, of which each row has the columns, named with the delimiter between them.

    **Raises:** `ValueError` as `read_text`, or for no rows, other columns, or a number that is not finite.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    require(len(lines) > 0, f"{path} is empty: unpack the data set again")
    try:
        rows = np.loadtxt(lines, delimiter=delimiter, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error}): each row must be {columns}") from error
    count = len(columns.split(delimiter))
    require(rows.shape[1] == count, f"{path} has {rows.shape[1]} columns; expected {count}: {columns}")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    require(bad.size == 0, f"{path} has numbers that are not finite, the first in row {bad[:1]}: unpack it again")
    return rows


def first(names: Sequence[object]) -> str:
    """The first few of many, and how many more there are."""
    more = len(names) - _MOST_NAMED
    return ", ".join(map(str, names[:_MOST_NAMED])) + (f" and {more} more" if more > 0 else "")
