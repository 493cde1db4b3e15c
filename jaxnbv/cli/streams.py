"""Output for any encoding, since the system's encoding of redirected output may lack characters."""

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
    """Replacement for characters that an encoding lacks: a similar text, or else their code."""
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end].translate(_READABLE)
    return text.encode("ascii", "backslashreplace").decode("ascii"), error.end


codecs.register_error("readable", _readable)


def write_readable() -> None:
    """Make the standard streams replace characters that their encoding lacks, such as "m2" for "m²"."""
    for stream in (sys.stdout, sys.stderr):
        # Streams of tests and notebooks have another type, and take all characters.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="readable")
