"""Text files of a local copy of a data set: what is missing or damaged is named."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import InputError, require


def check_listed(files: Sequence[Path], list_file: Path) -> None:
    """**Raises:** `ValueError` unless all files that a list names are there: how many are not, and the first."""
    absent = [file for file in files if not os.path.isfile(file)]
    require(
        not absent,
        f"{len(absent)} of the {len(files)} files that {list_file} names are not there, the first {absent[:1]}: unpack "
        "the data set again",
    )


def read_text(path: Path) -> str:
    """**Raises:** `ValueError` if the file is missing or is no text."""
    require(os.path.isfile(path), f"there is no file {path}: the folder is incomplete, unpack the data set again")
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
