"""Tables of a study: aligned text, and CSV."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

Row = dict[str, Any]


def standard_error(values: Float[np.ndarray, "scenes *rest"]) -> Float[np.ndarray, "*rest"]:
    """Of the mean over scenes, element by element; NaN for a single scene."""
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(values.std(axis=0, ddof=1) / math.sqrt(len(values)))


def text_grid(corner: str, rows: Sequence[str], columns: Sequence[str], cells: Mapping[tuple[str, str], str]) -> str:
    """One line for each row, aligned; cells by row and column."""
    width = max(map(len, (*cells.values(), *columns))) + 2
    head = f"  {corner:15}" + "".join(f"{column:>{width}}" for column in columns)
    lines = [f"  {row:15}" + "".join(f"{cells[row, column]:>{width}}" for column in columns) for row in rows]
    return "\n".join(line.rstrip() for line in [head, *lines]) + "\n"


def underlined(title: str) -> str:
    """A section's title."""
    return f"{title}\n{'=' * len(title)}\n"


def count_of(count: int, thing: str) -> str:
    """ "1 scene", "2 scenes"."""
    return f"{count} {thing}{'s' if count != 1 else ''}"


def write_csv(path: Path, rows: Sequence[Row], columns: Sequence[str]) -> Path:
    """Write rows under a header of the columns, floats to six digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for row in rows:
            writer.writerow({key: round(x, 6) if isinstance(x, float) else x for key, x in row.items()})
    return path
