"""Output of commands reaches terminals and files of every encoding, with substitutes for missing characters."""

import ast
import io
import os
import sys
from pathlib import Path
from unittest import mock

import pytest
from commands import TERMINAL

import jaxnbv
from jaxnbv.cli import main
from jaxnbv.cli.streams import write_readable

ENCODINGS = ("ascii", "cp1251", "cp932", "cp437", "latin-1", "gbk", "utf-8")


def written(text, encoding, name="stdout"):
    stream = io.TextIOWrapper(io.BytesIO(), encoding, errors="strict")
    with mock.patch.object(sys, name, stream):
        write_readable()
        print(text, file=getattr(sys, name), flush=True)
    return stream.buffer.getvalue().decode(encoding).rstrip("\n")


@pytest.mark.parametrize("name", ["stdout", "stderr"])
@pytest.mark.parametrize(
    ("encoding", "expected"),
    [
        ("ascii", "0.5 m2 +- 3 x 2 deg -1... \\u04f8"),
        ("cp1251", "0.5 m2 ± 3 x 2° -1… \\u04f8"),
        ("cp932", "0.5 m2 ± 3 × 2° －1… \\u04f8"),
        ("latin-1", "0.5 m² ± 3 × 2° -1... \\u04f8"),
        ("utf-8", "0.5 m² ± 3 × 2° −1… Ӹ"),
    ],
)
def test_a_likeness_stands_for_what_an_encoding_lacks(encoding, expected, name):
    assert written("0.5 m² ± 3 × 2° −1… Ӹ", encoding, name) == expected


def test_every_character_of_the_package_has_a_likeness():
    """No character is replaced by a code, which a reader would have to look up."""
    texts = {
        node.value
        for file in Path(jaxnbv.__file__).parent.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and not node.value.isascii()
    }
    assert len(texts) > 10
    for encoding in ENCODINGS:
        for text in texts:
            assert "\\u" not in written(text, encoding), (text, encoding)
            assert "\\x" not in written(text, encoding), (text, encoding)


def test_a_path_that_is_no_text_is_written_by_its_codes():
    assert written("runs/\udcff", "utf-8") == "runs/\\udcff"


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("words", "code"), [("demo --help", 0), ("run no.obj", 2)])
def test_commands_answer_in_every_encoding(words, code, encoding, monkeypatch):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding, errors="strict"))
    monkeypatch.setattr(sys, "argv", ["jaxnbv", *words.split()])
    with mock.patch.dict(os.environ, TERMINAL), pytest.raises(SystemExit) as leaving:
        main()
    assert leaving.value.code == code
