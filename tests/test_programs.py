"""Programs on disk: a later process neither traces nor compiles them, and gets the same numbers."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv import programs
from jaxnbv.checks import own_settings
from jaxnbv.compiled import PROGRAMS
from jaxnbv.programs import program
from jaxnbv.scanning import sdf

# A call of LAPACK, whose functions JAX finds only while it lowers, and one proposal. Prints the numbers of compiled
# programs and of traced functions of the package.
SCRIPT = """
import sys
import jax
import jax.numpy as jnp
import jaxnbv as nbv
from jaxnbv.programs import program
from jaxnbv.scanning import tracing

compiled, traced = [], []
jax.monitoring.register_event_listener(lambda event, **_: compiled.append(event.rpartition("/")[2]))
march = tracing.march
tracing.march = lambda *args: traced.append("march") or march(*args)
nbv.keep_compiled(sys.argv[1])

def largest(x):
    traced.append("largest")
    return jnp.linalg.eigh(x)[0][-1]

largest.__module__ = "jaxnbv.of_a_test"
assert program(largest)(jnp.eye(3) * 2.0) == 2.0
surface = nbv.SDFSurface(nbv.sdf.Sphere(0.8))
camera = nbv.Camera(height=8, width=8)
search = nbv.DiscreteSearch(6)
sampler = nbv.SurfaceSampler(nbv.ScreenedSPSR(nbv.GeometricSPSR(0.05, truncation=8)), nbv.Grid(24), 2)
planner = nbv.Planner(nbv.Coverage(), search, camera, sampler, capacity=64)
pose = search.poses_around()[0]
observations = planner.init(pose, nbv.scan(surface, camera, pose), camera)
proposal = planner.propose(observations, jax.random.key(0))
print(proposal.values.tolist(), len(traced), compiled.count("cache_misses"), sep=";")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(PROGRAMS, str(tmp_path))
    return tmp_path


def counted(function):
    """A program of a function of the package, and a list of the arguments of its traces."""
    calls = []

    def counting(*args, **kwargs):
        calls.append(args)
        return function(*args, **kwargs)

    counting.__module__, counting.__name__, counting.__qualname__ = "jaxnbv.of_a_test", "counting", "counting"
    return program(counting), calls


def propose(folder):
    """Run the script with this folder alone. It compiles as the tests do, since nothing is said about speed."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment |= {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT, str(folder)], env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    values, num_traced, num_compiled = result.stdout.split(";")
    return values, int(num_traced), int(num_compiled)


def test_a_later_process_traces_and_compiles_nothing(tmp_path):
    values, num_traced, num_compiled = propose(tmp_path)
    assert num_traced > 0
    assert num_compiled > 0
    assert propose(tmp_path) == (values, 0, 0)


class Line(eqx.Module):
    """A class outside the package."""

    slope: jax.Array

    def __call__(self, x):
        return self.slope * x


def test_numbers_and_structure_are_those_of_filter_jit(folder):
    def function(solid, x, power, *, label):
        return {"distance": solid(x) ** power, "solid": solid, "label": label, "none": None}

    ball, x = sdf.Sphere(0.5), np.linspace(-1, 1, 12, dtype=np.float32).reshape(4, 3)
    expected = eqx.filter_jit(function)(ball, x, 2, label="ball")
    for _ in range(2):
        # The second one is read from disk.
        stored, calls = counted(function)
        result = stored(ball, x, 2, label="ball")
        assert eqx.tree_equal(result, expected, typematch=True)
    assert len(calls) == 0


def test_another_kind_of_argument_is_another_program(folder):
    stored, calls = counted(lambda x, power: x**power)
    stored(jnp.ones(3), 2)
    for x, power in ((jnp.ones(4), 2), (jnp.ones(3), 3), (jnp.ones(3), 2.0), (jnp.ones(3, jnp.int32), 2), (1.0, 2)):
        before = len(calls)
        np.testing.assert_array_equal(stored(x, power), x**power)
        assert len(calls) == before + 1
    stored(jnp.zeros(3), 2)
    assert len(calls) == 6


def test_an_unused_argument_is_part_of_a_program(folder):
    """JAX drops unused arguments from lowered code, which is then the same for all of these."""
    x = jnp.ones(2)
    for function, arguments in (
        (lambda x, y: x + 1, (x, jnp.zeros(2))),
        (lambda x, y: y + 1, (jnp.zeros(2), x)),
        (lambda x, y: x + 1, (x, jnp.zeros(3))),
        (lambda x, y, z: x + 1, (x, jnp.zeros(2), jnp.zeros(2))),
    ):
        for _ in range(2):
            # The name of each is its own, since two functions of one name would be one entry.
            kept, calls = counted(function)
            kept._function.__qualname__ = str((id(function), len(arguments)))
            np.testing.assert_array_equal(kept(*arguments), [2.0, 2.0])
        assert len(calls) == 0


def test_settings_are_part_of_a_program(folder):
    stored, _ = counted(lambda x: x + jnp.asarray(0.1))
    assert stored(jnp.ones(2)).dtype == jnp.float32
    with jax.enable_x64(True):
        assert stored(jnp.ones(2)).dtype == jnp.float64
    with jax.debug_nans(True), pytest.raises(FloatingPointError):
        counted(jnp.log)[0](-jnp.ones(2))


def test_transfer_guards_are_no_part_of_a_program(folder):
    """The same program runs within `own_settings`, which allows transfers, and outside it."""
    stored, calls = counted(lambda x: 2.0 * x)
    stored(jnp.ones(2))
    with own_settings():
        stored(jnp.ones(2))
    assert len(calls) == 1


def test_code_of_others_is_not_kept(folder):
    """The user may change it, and a stored program would not follow."""
    stored, _ = counted(lambda line, x: line(x))
    np.testing.assert_array_equal(stored(Line(jnp.asarray(2.0)), jnp.ones(2)), [2.0, 2.0])
    np.testing.assert_array_equal(stored(lambda x: -x, jnp.ones(2)), [-1.0, -1.0])
    assert list(folder.iterdir()) == []


def test_what_calls_back_is_not_kept(folder):
    kind = jax.ShapeDtypeStruct((2,), jnp.float32)
    stored, _ = counted(lambda x: jax.pure_callback(lambda y: np.asarray(y) + 1, kind, x))
    np.testing.assert_array_equal(stored(jnp.ones(2)), [2.0, 2.0])
    assert list(folder.iterdir()) == []


def test_transformations_go_through(folder):
    stored, _ = counted(lambda x: jnp.sum(x**2))
    x = jnp.arange(3.0)
    np.testing.assert_array_equal(jax.grad(stored)(x), 2 * x)
    np.testing.assert_array_equal(jax.vmap(stored)(jnp.stack([x, x])), [5.0, 5.0])
    assert list(folder.iterdir()) == []


def test_a_damaged_file_is_made_again(folder):
    counted(lambda x: x + 1)[0](jnp.ones(2))
    files = list(folder.iterdir())
    assert len(files) == 2
    for file in files:
        file.write_bytes(file.read_bytes()[:-3])
    stored, calls = counted(lambda x: x + 1)
    np.testing.assert_array_equal(stored(jnp.ones(2)), [2.0, 2.0])
    assert len(calls) == 1
    stored, calls = counted(lambda x: x + 1)
    np.testing.assert_array_equal(stored(jnp.ones(2)), [2.0, 2.0])
    assert len(calls) == 0


def test_a_program_that_cannot_be_written_works(folder, monkeypatch):
    (folder / "file").write_text("")
    monkeypatch.setenv(PROGRAMS, str(folder / "file"))
    with pytest.warns(UserWarning, match="cannot be kept in .*file .*give keep_compiled another folder"):
        np.testing.assert_array_equal(counted(lambda x: x + 1)[0](jnp.ones(2)), [2.0, 2.0])


def test_after_an_edit_the_same_code_is_not_compiled_again(folder, monkeypatch):
    counted(lambda x: x + 1)[0](jnp.ones(2))
    monkeypatch.setattr(programs, "_source", lambda: "edited")
    monkeypatch.setattr(programs, "_compile_uncached", lambda lowered: pytest.fail("compiled"))
    stored, calls = counted(lambda x: x + 1)
    np.testing.assert_array_equal(stored(jnp.ones(2)), [2.0, 2.0])
    assert len(calls) == 1
