"""Docstrings: present where a name is exported, with a short first line, errors named, and plain openings."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxnbv"
# A text that opens with one of these is a fragment: its noun or its verb is missing.
FRAGMENT = re.compile(r"(As|Of|Such|That|Those|What|Which|Whose|With)\b")
Definition = ast.ClassDef | ast.FunctionDef


def definitions(tree: ast.AST, inside: str = "") -> Iterator[tuple[str, Definition, str]]:
    """Name, definition and docstring of the enclosing class, for public classes, functions and methods."""
    for node in getattr(tree, "body", []):
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield node.name, node, inside
            if isinstance(node, ast.ClassDef):
                yield from definitions(node, ast.get_docstring(node) or "")


PUBLIC = {
    f"{path.relative_to(ROOT)}:{node.lineno} {name}": (node, ast.get_docstring(node), around)
    for path in sorted(PACKAGE.rglob("*.py"))
    for name, node, around in definitions(ast.parse(path.read_text()))
}


def exported() -> set[str]:
    """Names that a package's `__init__` imports for its users, as `from module import Name as Name`."""
    faces = [ast.parse(path.read_text()) for path in PACKAGE.rglob("__init__.py*") if path.suffix in (".py", ".pyi")]
    imports = [node for tree in faces for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {alias.name for node in imports for alias in node.names if alias.name == alias.asname}


def refuses(node: Definition) -> bool:
    """Whether it is a function that itself raises an error with a message, or calls `require`."""
    return isinstance(node, ast.FunctionDef) and any(
        (isinstance(part, ast.Raise) and isinstance(part.exc, ast.Call))
        or (isinstance(part, ast.Call) and ast.unparse(part.func).endswith("require"))
        for part in ast.walk(node)
    )


def openings(path: Path) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring (also of attributes), and of the first line of every comment."""
    source, last = path.read_text(), -1
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value.strip()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] > last + 1:
                yield token.start[0], token.string.lstrip("# ")
            last = token.start[0]


def test_exported_names_have_docstrings():
    """A method may leave its docstring to its base class, and a property to a line of its class."""
    names, bare = exported(), {}
    assert len(names) > 100
    declared = {node.name for node, text, around in PUBLIC.values() if text or f"`{node.name}`" in around}
    for place, (node, text, _) in PUBLIC.items():
        if not text and (node.name in names if isinstance(node, ast.ClassDef) else node.name not in declared):
            bare[place] = node.name
    assert bare == {}


def test_first_lines_are_short_and_end():
    lines = {place: text.splitlines()[0] for place, (_, text, _) in PUBLIC.items() if text}
    assert [place for place, line in lines.items() if len(line) > 100 or line[-1] not in ".:"] == []


def test_functions_that_refuse_an_argument_say_so():
    """Docstrings of commands are help texts, and name no Python errors."""
    refusing = {place: texts for place, (node, *texts) in PUBLIC.items() if refuses(node) and "/cli/" not in place}
    assert [place for place, texts in refusing.items() if "Raise" not in str(texts)] == []


@pytest.mark.parametrize("folder", ["jaxnbv", "examples", "benchmarks", "scripts", "tests"])
def test_no_docstring_or_comment_is_a_fragment(folder):
    places = [(path, *opening) for path in sorted((ROOT / folder).rglob("*.py")) for opening in openings(path)]
    assert [f"{path.relative_to(ROOT)}:{line} {text[:60]}" for path, line, text in places if FRAGMENT.match(text)] == []
