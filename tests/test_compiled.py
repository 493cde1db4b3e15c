"""Compiled programs on disk: a later process compiles nothing, and warnings say why programs are not stored."""

import os
import subprocess
import sys
from unittest import mock

import jax
import pytest
from commands import run_command

import jaxnbv as nbv
from jaxnbv.compiled import PROGRAMS

# Programs that compile within a millisecond or two are stored as well.
SCRIPT = """
import sys
import jax
import jax.numpy as jnp
import jaxnbv as nbv

if sys.argv[2] == "late":
    jax.jit(jnp.sin)(1.0)
assert nbv.keep_compiled(sys.argv[1]) == sys.argv[1]
compiled = []
jax.monitoring.register_event_listener(lambda event, **_: compiled.append(event.rpartition("/")[2]))
print(float(jax.jit(lambda x: x + 1.0)(1.0)), compiled.count("cache_hits"), compiled.count("cache_misses"))
"""


def run_script(folder, when="first"):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", SCRIPT, str(folder), when]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    value, hits, misses = result.stdout.split()
    assert float(value) == 2.0
    return int(hits), int(misses), result.stderr


def test_a_later_process_compiles_nothing_unless_a_program_is_damaged(tmp_path):
    hits, misses, said = run_script(tmp_path, "late")
    assert (hits, said) == (0, "")
    assert misses > 0
    assert run_script(tmp_path) == (misses, 0, "")
    for file in tmp_path.iterdir():
        file.write_bytes(b"damaged")
    hits, _, said = run_script(tmp_path)
    assert hits == 0
    assert said.count("Error reading persistent compilation cache entry") == misses


@pytest.fixture
def settings():
    """JAX's settings of this process, restored after the test."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: jax.config.values[name] for name in names}
    with mock.patch.dict(os.environ):
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    nbv.keep_compiled()
    # Other tests compile as usual.
    del os.environ[PROGRAMS]


def test_a_folder_that_cannot_be_written_is_refused_and_changes_nothing(tmp_path, settings):
    (tmp_path / "file").write_text("")
    before = jax.config.jax_compilation_cache_dir
    with pytest.raises(nbv.InputError, match=r"file.*: give keep_compiled a folder that can be written"):
        nbv.keep_compiled(tmp_path / "file")
    assert jax.config.jax_compilation_cache_dir == before


def test_the_command_line_warns_of_it_and_goes_on(tmp_path, settings):
    (tmp_path / "file").write_text("")
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "file"))
    result = run_command("study", "pyramid", "--help", cwd=tmp_path)
    assert result.returncode == 0
    (line,) = result.stderr.splitlines()
    assert line.startswith("warning: compiled programs cannot be kept in")


def test_a_folder_that_jax_was_given_stays(tmp_path, settings):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    assert nbv.keep_compiled() == str(tmp_path / "mine") == os.environ["JAX_COMPILATION_CACHE_DIR"]
