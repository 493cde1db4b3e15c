"""What the site's pages name is there: commands, options, messages, public names; and formulas are whole."""

import importlib
import inspect
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import typer

from jaxnbv import cli

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))


def test_messages_that_are_explained_are_given():
    """Each in the code, where it may be broken over lines."""
    code = "".join(re.sub(r'"\s*\n\s*f?"', "", path.read_text()) for path in (ROOT / "jaxnbv").rglob("*.py"))
    said = (DOCS / "how_to" / "trouble.md").read_text().partition("## It says nothing")[0]
    messages = [phrase for row in re.findall(r"(?m)^\| (`.*?) \|", said) for phrase in re.findall("`([^`]+)`", row)]
    assert len(messages) > 10
    assert [message for message in messages if message not in code] == []


def commands(text: str) -> list[list[str]]:
    """Those of blocks of shell, without the variables that are set before them."""
    found = []
    for block in re.findall(r"(?ms)^```bash\n(.*?)^```$", text):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            while words and re.match(r"[A-Z_]+=", words[0]):
                words.pop(0)
            while words:
                end = words.index("&&") if "&&" in words else len(words)
                found.append(words[:end])
                words = words[end + 1 :]
    return found


COMMAND = typer.main.get_command(cli.app)


def parse(arguments: list[str], whole: bool = True) -> None:
    """As the command line takes them. Runs nothing. What is named in a sentence need not be whole."""
    command = COMMAND
    while arguments and arguments[0] in getattr(command, "commands", {}):
        command, arguments = command.commands[arguments[0]], arguments[1:]
    known = getattr(command, "commands", {})
    if known and not arguments and not whole:
        return
    assert not known or arguments[0].startswith("-"), f"{arguments[0]} is none of {', '.join(known)}"
    try:
        command.make_context("jaxnbv", list(arguments))
    except typer.Exit:
        pass  # After its help or its version.
    except Exception as error:
        # Typer carries its own click, or does not.
        if whole or type(error).__name__ != "MissingParameter":
            raise


def check_script(arguments: list[str]) -> None:
    """A script of the repository, whose parser names the options."""
    if arguments[0] == "-m":
        assert arguments[1] == "venv"
        return
    source = (ROOT / arguments[0]).read_text()
    missing = [word for word in arguments if word.startswith("--") and f'"{word}"' not in source]
    assert not missing


def check_extras(arguments: list[str]) -> None:
    """Extras that are installed are those of the package."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = [name for word in arguments for group in re.findall(r"\[(.*)\]", word) for name in group.split(",")]
    assert set(named) <= set(extras)


CHECKS = {"jaxnbv": parse, "python": check_script, "python3": check_script, "pip": check_extras, "uv": check_extras}
# Programs of others, whose options are not looked at.
OTHERS = {"mkdir", "tar", "dask", "ruff", "mypy", "pytest", "sphinx-build"}


@pytest.mark.parametrize("page", ["../README.md", "../CONTRIBUTING.md", *PAGES])
def test_the_commands_of_a_page_are_there(page, capsys):
    text = (DOCS / page).read_text()
    for program, *arguments in commands(text):
        name = Path(program).name
        assert name in CHECKS or name in OTHERS, f"{program} is no program that is known here"
        CHECKS.get(name, lambda _: None)(arguments)
    for command in re.findall(r"`jaxnbv ([^`]+)`", text):
        parse(shlex.split(command), whole=False)


def test_commands_that_are_not_there_are_refused():
    """Or the test above would say nothing."""
    found = commands("```bash\nX=1 jaxnbv run a --vews 3 && python benchmarks/all.py --mash b  # more\n```\n")
    assert found == [["jaxnbv", "run", "a", "--vews", "3"], ["python", "benchmarks/all.py", "--mash", "b"]]
    with pytest.raises(Exception, match="No such option"):
        parse(found[0][1:])
    with pytest.raises(AssertionError):
        check_script(found[1][1:])
    with pytest.raises(AssertionError):
        check_extras(["install", ".[cuba]"])


@pytest.mark.parametrize("page", PAGES)
def test_formulas_in_tables_are_whole(page):
    """A bar ends a cell of a table, within a formula too."""
    rows = [line for line in (DOCS / page).read_text().splitlines() if line.startswith("|")]
    assert not [cell for row in rows for cell in row.split("|") if cell.count("$") % 2]


def documented() -> dict[str, list[str]]:
    names: dict[str, list[str]] = {}
    for page in sorted((DOCS / "reference").glob("*.md")):
        module = ""
        for directive, argument in re.findall(r"(?m)^\.\. (\w+):: (\S+)$", page.read_text()):
            if directive == "currentmodule":
                module = argument
            else:
                names.setdefault(module, []).append(argument)
    return names


STUDIES = ("studies.readers", "studies.scenes")
PACKAGES = ("networks", "scanning", "search", "surfaces", "tasks", "viz", *STUDIES)


@pytest.mark.parametrize("package", ["jaxnbv", *(f"jaxnbv.{name}" for name in PACKAGES)])
def test_every_public_class_and_function_has_its_place_in_the_reference(package):
    names = documented()
    module = importlib.import_module(package)
    public = getattr(module, "__all__", None) or [name for name in vars(module) if not name.startswith("_")]
    of = {name: getattr(module, name) for name in public}
    wanted = {name for name, thing in of.items() if inspect.isclass(thing) or inspect.isfunction(inspect.unwrap(thing))}
    known = {*names.get(package, []), *names["jaxnbv"]}
    assert wanted <= known
    assert len(names[package]) == len(set(names[package]))


def test_the_example_of_style_is_the_code():
    """CONTRIBUTING.md shows a class as it is."""
    (shown,) = re.findall(r"(?ms)^```python\n(.*?)^```$", (ROOT / "CONTRIBUTING.md").read_text())
    assert shown.strip() in (ROOT / "jaxnbv" / "tasks" / "coverage.py").read_text()
