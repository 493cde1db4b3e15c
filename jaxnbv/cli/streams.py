"""Output of the command line: replaces characters that an encoding lacks, and prints each warning only once."""

import codecs
import io
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer

_LETTERS = dict(zip("²³×−—–·•●★█■○◯’", "23x---****##oo'", strict=True))
_READABLE = str.maketrans(_LETTERS | {"±": "+-", "°": " deg", "…": "...", "→": "->", "✓": "ok"})


def _readable(error: UnicodeError) -> tuple[str, int]:
    """Return a replacement for the characters that an encoding lacks, and the position after them.

    The replacement consists of similar characters, such as "m2" for "m²", or escape codes.
    """
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end].translate(_READABLE)
    return text.encode("ascii", "backslashreplace").decode("ascii"), error.end


codecs.register_error("readable", _readable)


def write_readable() -> None:
    """Make the standard streams replace characters that their encoding lacks, for example "m²" by "m2"."""
    for stream in (sys.stdout, sys.stderr):
        # Streams of tests and notebooks are not of this type, and can print all characters.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="readable")


@contextmanager
def each_warning_once() -> Iterator[None]:
    """Context manager: print each warning once, and at the end how often each repeated warning occurred.

    Python's own filter prints warnings again whenever a library has changed the filters.
    """
    counts: Counter[str] = Counter()
    show_warning = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any) -> None:
        is_ours = issubclass(category, UserWarning)
        text = str(message) if is_ours else warnings.formatwarning(message, category, filename, lineno).strip()
        counts[text] += 1
        if counts[text] == 1:
            typer.echo(f"warning: {text}", err=True)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = show_warning
        for text, count in counts.items():
            if count > 1:
                typer.echo(f"warning, {count} times in all: {text}", err=True)
