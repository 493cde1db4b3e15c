"""Output that any encoding can take: where it is redirected, that is often the system's, of few characters."""

import codecs
import io
import sys

_READABLE = str.maketrans(
    {
        "²": "2",
        "³": "3",
        "±": "+-",
        "×": "x",
        "−": "-",
        "°": " deg",
        "·": "*",
        "•": "*",
        "…": "...",
        "—": "-",
        "–": "-",
        "→": "->",
        "●": "*",
        "█": "#",
        "■": "#",
        "○": "o",
        "◯": "o",
        "★": "*",
        "✓": "ok",
        "’": "'",
    }
)


def _readable(error: UnicodeError) -> tuple[str, int]:
    """What stands for the characters that an encoding lacks: a likeness, else their code."""
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end].translate(_READABLE)
    return text.encode("ascii", "backslashreplace").decode("ascii"), error.end


codecs.register_error("readable", _readable)


def write_readable() -> None:
    """Let the standard streams write a likeness of what their encoding lacks, "m2" for "m²", and refuse nothing."""
    for stream in (sys.stdout, sys.stderr):
        # Those of tests and of notebooks are others, which take all characters.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="readable")
