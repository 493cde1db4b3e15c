"""The folders are the architecture: imports follow the order of the packages, without cycles."""

import ast
from pathlib import Path

import pytest

import jaxnbv

ROOT = Path(jaxnbv.__file__).parent
# Data flows down this list. Each package imports only from those before it and from itself.
ORDER = (
    "version",
    "errors",
    "compiled",
    "programs",
    "progress",
    "checks",
    "sharding",
    "geometry",
    "scanning",
    "observations",
    "surfaces",
    "sampler",
    "utility",
    "acquisition",
    "tasks",
    "search",
    "storage",
    "networks",
    "readers",
    "planning",
    "viz",
    "studies",
    "cli",
)
# Packages outside the library. The root and the packages before them do not import them.
LABORATORY = ("studies", "cli")
FILES = {
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in ROOT.rglob("*.py")
}


def imported(path: Path, name: str) -> set[str]:
    """Modules of the package that a file names: in any import, in its stub, and in strings that are names of modules,
    as in registries and for `import_module`."""
    imports: set[str] = set()
    stub = path.with_suffix(".pyi")
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for source in (path, stub) if stub.exists() else (path,):
        for node in ast.walk(ast.parse(source.read_text())):
            if isinstance(node, ast.Import):
                imports |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = f"{package}.{node.module or ''}".rstrip(".") if node.level else node.module or ""
                imports |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                imports.add(node.value.partition(":")[0])
    # A package that is imported together with its members counts by these.
    modules = {module for module in imports if module in FILES and module != "jaxnbv"}
    return modules - {name}


GRAPH = {name: imported(path, name) for name, path in FILES.items()}


def package_of(module: str) -> str:
    return (*module.split("."), "")[1]


def test_the_listing_holds_these_packages_and_no_others():
    there = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert there == {*ORDER, "__init__", "__main__"}


@pytest.mark.parametrize("package", ORDER)
def test_imports_follow_the_order(package):
    place = ORDER.index(package)
    wrong = {
        f"{name} -> {other}"
        for name, others in GRAPH.items()
        if package_of(name) == package
        for other in others
        if ORDER.index(package_of(other)) > place
    }
    assert wrong == set()


def test_the_library_and_its_root_import_nothing_of_the_laboratory():
    library = {name: others for name, others in GRAPH.items() if package_of(name) not in (*LABORATORY, "__main__")}
    wrong = {
        f"{name} -> {other}" for name, others in library.items() for other in others if package_of(other) in LABORATORY
    }
    assert wrong == set()
    assert {"jaxnbv.search", "jaxnbv.planning.session"} <= library["jaxnbv"]


def test_no_file_imports_itself_by_way_of_others():
    """Kahn's algorithm. A package's `__init__`, which lists its members, does not count."""
    faces = {name for name, path in FILES.items() if path.name == "__init__.py"}
    graph = {name: {other for other in others if other not in faces} for name, others in GRAPH.items()}
    graph = {name: others for name, others in graph.items() if name not in faces}
    while leaves := [name for name, others in graph.items() if not others & graph.keys()]:
        for name in leaves:
            del graph[name]
    assert graph == {}


def test_the_reader_of_imports_sees_each_kind(tmp_path):
    file = tmp_path / "probe.py"
    file.write_text(
        "import jaxnbv.checks\nfrom jaxnbv.search import base\n\ndef f():\n    from jaxnbv.viz import report\n"
        "    import_module('jaxnbv.cli.registry')\n\nENTRY = 'jaxnbv.studies.parts.study:PartStudy'\n"
    )
    assert imported(file, "jaxnbv.probe") == {
        "jaxnbv.checks",
        "jaxnbv.search",
        "jaxnbv.search.base",
        "jaxnbv.viz",
        "jaxnbv.viz.report",
        "jaxnbv.cli.registry",
        "jaxnbv.studies.parts.study",
    }
