"""Writes files completely or not at all, and creates folders. Error messages contain the path."""

import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxnbv.errors import InputError

# Pattern of the names of partial files, which a killed process leaves behind.
PARTS = "." + 16 * "[0-9a-f]" + ".partial"


def write_whole(path: Path, write: Callable[[Any], Any]) -> None:
    """Write a file completely or not at all: a reader finds the old file or the complete new file.

    - `write`: function that writes the content to its argument, a partial file that is open in binary mode. The partial
      file is then renamed to `path`.

    **Raises:** `ValueError` if the disk is full, the folder is missing or may not be written, or the name is too long.
    """
    # The name is random, so two processes that write the same file use different partial files.
    partial = path.with_name(f".{secrets.token_hex(8)}.partial")
    try:
        try:
            with partial.open("xb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(
            f"cannot write {path} ({error.strerror or error}): make room there or choose another place. "
            "What was finished before is kept"
        ) from error


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes as `write_whole` does."""
    write_whole(path, lambda file: file.write(content))


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text as `write_whole` does."""
    write_bytes(path, text.encode())


def make_folder(path: str | Path) -> Path:
    """Create a folder and its parents if the folder is missing, and return its path.

    **Raises:** `ValueError` if there is a file at this path, or if the folder cannot be created.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError, TypeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot make the output folder {path!r} ({reason}): choose another place") from error
    return Path(path)
