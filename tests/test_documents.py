"""Everything that the README and the site's pages name exists: files, commands, options, messages and public names.
Formulas are complete."""

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
DOCUMENTS = ["../README.md", "../CONTRIBUTING.md", "../CHANGELOG.md", *PAGES]


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_and_paths_lead_somewhere(document):
    text = (DOCS / document).read_text()
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    named = re.findall(r"`((?:jaxnbv|tests|docs|scripts|benchmarks|examples|notebooks|\.ci)/[\w./-]*)`", text)
    # Sphinx copies the notebooks into the site.
    beside = [(DOCS / document).parent / link for link in links if "://" not in link]
    beside = [ROOT / "notebooks" / path.name if path.parent.name == "notebooks" else path for path in beside]
    missing = [str(path) for path in (*beside, *(ROOT / name for name in named)) if not path.exists()]
    assert not missing


def test_a_package_page_has_links_to_the_web_alone():
    """For the README as the package's build rewrites it."""
    text = (ROOT / "README.md").read_text()
    links = re.compile(r"!?\[[^\]]*\]\(([^)]*)\)")
    assert "docs/demo.gif" in links.findall(text)
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]
    for change in hook["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    left = links.findall(text)
    assert left
    assert all(link.startswith("https://") for link in left)
    assert "concepts, each formula" in text


@pytest.mark.parametrize("name", ["main", "test"])
def test_each_command_of_the_readme_is_one_line(name):
    text = (ROOT / "README.md").read_text()
    assert re.search(rf"<!-- {name} command -->\n```bash\n[^\n]*\n```", text)


def test_explained_messages_exist():
    """Each message is in the code, where it may span lines."""
    code = "".join(re.sub(r'"\s*\n\s*f?"', "", path.read_text()) for path in (ROOT / "jaxnbv").rglob("*.py"))
    said = (DOCS / "how_to" / "trouble.md").read_text().partition("## It says nothing")[0]
    messages = [phrase for row in re.findall(r"(?m)^\| (`.*?) \|", said) for phrase in re.findall("`([^`]+)`", row)]
    assert len(messages) > 10
    assert [message for message in messages if message not in code] == []


def commands(text: str) -> list[list[str]]:
    """Commands in blocks of shell, without variables that are set before them."""
    command_lines = []
    for block in re.findall(r"(?ms)^```bash\n(.*?)^```$", text):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            while words and re.match(r"[A-Z_]+=", words[0]):
                words.pop(0)
            while words:
                end = words.index("&&") if "&&" in words else len(words)
                command_lines.append(words[:end])
                words = words[end + 1 :]
    return command_lines


COMMAND = typer.main.get_command(cli.app)


def parse(arguments: list[str], whole: bool = True) -> None:
    """Check a command with the parser of the command line. Runs nothing. In a sentence a command may lack arguments."""
    command = COMMAND
    while arguments and arguments[0] in getattr(command, "commands", {}):
        command, arguments = command.commands[arguments[0]], arguments[1:]
    subcommands = getattr(command, "commands", {})
    if subcommands and not arguments and not whole:
        return
    assert not subcommands or arguments[0].startswith("-"), f"{arguments[0]} is none of {', '.join(subcommands)}"
    try:
        command.make_context("jaxnbv", list(arguments))
    except typer.Exit:
        pass  # Raised after the help or the version.
    except Exception as error:
        # Some versions of typer have their own click.
        if whole or type(error).__name__ != "MissingParameter":
            raise


def check_script(arguments: list[str]) -> None:
    """Check a script of the repository. Its parser names the options."""
    if arguments[0] == "-m":
        assert arguments[1] == "venv"
        return
    source = (ROOT / arguments[0]).read_text()
    missing = [word for word in arguments if word.startswith("--") and f'"{word}"' not in source]
    assert not missing


def check_extras(arguments: list[str]) -> None:
    """Check that installed extras are extras of the package."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = [name for word in arguments for group in re.findall(r"\[(.*)\]", word) for name in group.split(",")]
    assert set(named) <= set(extras)


CHECKS = {"jaxnbv": parse, "python": check_script, "python3": check_script, "pip": check_extras, "uv": check_extras}
# Other programs, whose options are not checked.
OTHERS = {"mkdir", "tar", "cp", "ruff", "mypy", "pytest", "sphinx-build", "dask"}


@pytest.mark.parametrize("page", DOCUMENTS)
def test_the_commands_of_a_page_are_there(page, capsys):
    text = (DOCS / page).read_text()
    for program, *arguments in commands(text):
        name = Path(program).name
        assert name in CHECKS or name in OTHERS, f"{program} is no program that is known here"
        CHECKS.get(name, lambda _: None)(arguments)
    for command in re.findall(r"`jaxnbv ([^`]+)`", text):
        parse(shlex.split(command), whole=False)


@pytest.mark.parametrize("page", PAGES)
def test_formulas_in_tables_are_whole(page):
    """A bar ends a table cell, even within a formula."""
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


PACKAGES = ("networks", "readers", "scanning", "search", "studies.scenes", "surfaces", "tasks", "viz")


@pytest.mark.parametrize("package", ["jaxnbv", *(f"jaxnbv.{name}" for name in PACKAGES)])
def test_every_public_class_and_function_has_its_place_in_the_reference(package):
    names = documented()
    module = importlib.import_module(package)
    public = getattr(module, "__all__", None) or [name for name in vars(module) if not name.startswith("_")]
    of = {name: getattr(module, name) for name in public}
    wanted = {name for name, thing in of.items() if inspect.isclass(thing) or inspect.isfunction(inspect.unwrap(thing))}
    listed = {*names.get(package, []), *names["jaxnbv"]}
    assert wanted <= listed
    assert len(names[package]) == len(set(names[package]))


def test_the_example_of_style_is_the_code():
    """CONTRIBUTING.md shows the class as it is in the code."""
    (example,) = re.findall(r"(?ms)^```python\n(.*?)^```$", (ROOT / "CONTRIBUTING.md").read_text())
    assert example.strip() in (ROOT / "jaxnbv" / "tasks" / "coverage.py").read_text()
