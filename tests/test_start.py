"""The start: `jaxnbv` answers without JAX where it can, because importing JAX takes seconds, and has all its names."""

import ast
import importlib.metadata
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import jaxnbv
import jaxnbv as nbv
from jaxnbv.errors import EXTRAS
from jaxnbv.studies import scenes

PACKAGES = [jaxnbv, nbv.readers, nbv.viz, scenes]
LAZY = pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)


def public_imports(package) -> list[ast.stmt]:
    return ast.parse(Path(inspect.getfile(package)).with_suffix(".pyi").read_text()).body


def run_fresh(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=600)


def test_help_and_typos_are_answered_without_jax():
    """One after the other in one process, with a check of its modules after each."""
    script = """
import sys
from jaxnbv.cli import main

ANSWERED = {"": 2, "--help": 0, "--version": 0, "demo --help": 0, "run --help": 0, "study --help": 0}
ANSWERED |= {"study pyramid --help": 0, "dmeo": 2, "demo --vews 3": 2, "demo --search best": 2}
for words, code in ANSWERED.items():
    sys.argv, found = ["jaxnbv", *words.split()], 0
    try:
        main()
    except SystemExit as leaving:
        found = leaving.code or 0
    assert found == code, words
    assert not {"jax", "equinox", "scipy", "matplotlib", "trimesh"} & {*sys.modules}, words
"""
    result = run_fresh("-c", script)
    assert result.returncode == 0, result.stderr
    assert f"\njaxnbv {jaxnbv.__version__}\n" in result.stdout
    assert jaxnbv.__version__ == importlib.metadata.version("jaxnbv")


def test_a_misspelt_name_suggests_the_nearest():
    for wrong, right in (("Covrage", "Coverage"), ("coverage", "Coverage"), ("sessions", "Session")):
        with pytest.raises(AttributeError, match=f"no attribute '{wrong}'. Did you mean '{right}"):
            getattr(nbv, wrong)
    with pytest.raises(AttributeError, match=r"no attribute 'quaternions'\.$"):
        nbv.quaternions  # noqa: B018


def test_a_session_at_a_robot_loads_no_pictures_studies_or_networks():
    """An episode does not load them either, until it is drawn. Names that need a missing extra say how to install it.
    JAX is loaded at the first use of a name."""
    script = f"""
import sys
for extra in {[*EXTRAS]}:
    sys.modules[extra] = None
import jaxnbv
assert "jax" not in sys.modules
jaxnbv.Session, jaxnbv.simulate, jaxnbv.DiscreteSearch, jaxnbv.load_mesh
print(*sys.modules)
for use in (lambda: jaxnbv.write_report, lambda: jaxnbv.ColdestPoint((0.0, 0.0, 0.0))):
    try:
        use()
    except jaxnbv.InputError as error:
        print(error, file=sys.stderr)
"""
    result = run_fresh("-c", script)
    assert result.returncode == 0, result.stderr
    loaded = {*result.stdout.split()}
    assert {"jax", "jaxnbv.planning.session", "jaxnbv.storage"} <= loaded
    assert loaded & {"jaxnbv.viz", "jaxnbv.studies"} == set()
    for line, extra in zip(result.stderr.splitlines(), ("report", "heat"), strict=True):
        assert line.endswith(f'pip install ".[{extra}]" in a clone of jaxnbv')


def test_every_extra_that_is_named_exists():
    assert {*EXTRAS.values()} <= {*importlib.metadata.metadata("jaxnbv").get_all("Provides-Extra")}


@LAZY
def test_every_public_name_resolves(package):
    assert dir(package) == package.__all__
    for name in package.__all__:
        assert getattr(package, name) is not None
    with pytest.raises(AttributeError, match="Plannr"):
        _ = package.Plannr


@LAZY
def test_type_checkers_see_every_public_name(package):
    """In a stub `import x` is private, and `import x as x` is public. The lazy package does not need that form."""
    imports = public_imports(package)
    assert all(isinstance(statement, ast.ImportFrom) for statement in imports)
    aliases = [alias for statement in imports for alias in statement.names]
    assert [alias.asname for alias in aliases] == [alias.name for alias in aliases]
    assert sorted(alias.name for alias in aliases) == package.__all__
    assert (Path(inspect.getfile(jaxnbv)).parent / "py.typed").exists()


@pytest.mark.slow
def test_every_public_module_can_be_the_first_that_is_used():
    """Modules that import each other in a cycle would work only after some first names."""
    imports = public_imports(jaxnbv)
    named = [(statement.module, statement.names[0].name) for statement in imports]
    first_names = {name if inspect.ismodule(getattr(jaxnbv, name)) else module: name for module, name in named}
    script = f"""
import sys
for name in {[*first_names.values()]}:
    for module in [module for module in sys.modules if module.split(".")[0] == "jaxnbv"]:
        del sys.modules[module]
    import jaxnbv
    getattr(jaxnbv, name)
"""
    result = run_fresh("-c", script)
    assert result.returncode == 0, result.stderr
