"""Reads text files that other programs wrote. Such files may have a byte order mark, UTF-16 or blank lines."""

import json
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import InputError

# Infinities and NaN as Microsoft's C runtime prints them.
_NOT_FINITE = re.compile(r"[+-]?1\.#[A-Z]+\d*")


def read_text(path: Path) -> str:
    """Read the text of a file in UTF-8, UTF-16 or UTF-32, without its byte order mark.

    **Raises:** `OSError` if the file cannot be read.
    """
    content = path.read_bytes()
    return content.decode(json.detect_encoding(content), "surrogateescape")


def read_rows(path: Path) -> list[list[str]]:
    """Read the words of each line of a file, without blank lines and lines that begin with #."""
    rows = (line.split() for line in read_text(path).splitlines())
    return [row for row in rows if row and not row[0].startswith("#")]


def read_table(path: Path) -> Float[np.ndarray, "rows columns"]:
    """Read a table of numbers from a text file.

    **Raises:** `ValueError` if the file is empty, has words that are not numbers, or rows of different lengths;
    `OSError` if it cannot be read.
    """
    try:
        rows = [[float(_NOT_FINITE.sub("nan", word)) for word in row] for row in read_rows(path)]
        table = np.array(rows)
    except ValueError as error:
        raise InputError(f"{path} is no table of numbers: {error}") from error
    if table.ndim != 2:
        raise InputError(f"{path} is no table of numbers: it is empty")
    return table
