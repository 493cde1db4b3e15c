"""The installed JAX passes the known reproductions of errors on a CPU. Versions that do not are refused."""

import os
import subprocess
import sys

import pytest

from jaxnbv.version import check_jax

# Compiled as users compile, and compared with NumPy in double precision. jax issue 39103 is a matrix-vector product
# under vmap, followed by a reduction: rows after the 32,768th were wrong in single precision, and after the 16,384th in
# double. Issues 39257 and 40412 end the process: sums over arrays of rank 8 and 7.
PROGRAMS = """
import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
REDUCTIONS = {
    "sum": (jnp.sum, np.sum),
    "sum of squares": (lambda row: jnp.sum(row**2), lambda x, axis: np.sum(x**2, axis)),
    "max": (jnp.max, np.max),
    "least magnitude": (lambda row: jnp.min(jnp.abs(row)), lambda x, axis: np.min(np.abs(x), axis)),
    "norm": (jnp.linalg.norm, lambda x, axis: np.linalg.norm(x, axis=axis)),
}
matrix = np.array([[0.6, -0.8, 0.1], [0.8, 0.6, -0.2], [0.1, 0.3, 1.0]])
for dtype, rows in ((np.float32, 32_769), (np.float32, 40_961), (np.float64, 16_385)):
    x = np.random.default_rng(0).normal(size=(rows, 3)).astype(dtype)
    for name, (reduction, oracle) in REDUCTIONS.items():
        values = jax.jit(jax.vmap(lambda row: reduction(jnp.asarray(matrix, dtype) @ row)))(x)
        expected = oracle(x.astype(float) @ matrix.T, axis=1)
        wrong = np.flatnonzero(np.abs(values - expected) > 1e-4)
        assert len(wrong) == 0, f"{name} of {rows} rows in {dtype.__name__}: wrong from {wrong[0]} on"

a, b = jnp.ones((10, 4, 6), jnp.float32), jnp.ones((10, 4, 6, 9, 9, 9, 9, 9), jnp.float32)
summed = jax.jit(lambda a, b: jnp.log(jnp.sum(a[(..., *[None] * 5)] * b, axis=2)))(a, b)
np.testing.assert_allclose(summed, np.log(6), rtol=1e-6)
a = np.random.default_rng(0).normal(size=(3, 1, 2, 2, 8, 8, 8)).astype(np.float32)
np.testing.assert_allclose(jax.jit(lambda a: jnp.sum(a * a, axis=3))(a), (a * a).sum(3), rtol=1e-5)
"""


def test_the_installed_version_passes_known_reproductions():
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))}
    environment |= {"JAX_PLATFORMS": "cpu"}
    result = subprocess.run([sys.executable, "-c", PROGRAMS], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.parametrize("version", ["0.8.3", "0.9.1", "0.9.2", "0.10.0", "0.10.1", "0.10.2", "0.11.0"])
def test_a_wrong_version_is_refused_by_its_name(version):
    with pytest.raises(ImportError, match=rf"jaxlib {version} .*pip install -U 'jax.*!=0.11.0"):
        check_jax(version)


@pytest.mark.parametrize("version", ["0.9.0", "0.9.0.1", "0.11.1", "0.12.0.1", "0.13.0.dev20261101", "0.12.0+cuda"])
def test_other_versions_are_accepted(version):
    check_jax(version)


def test_a_wrong_version_is_refused_at_import():
    script = """
import importlib.metadata

version = importlib.metadata.version
importlib.metadata.version = lambda name: "0.10.2" if name == "jaxlib" else version(name)
import jaxnbv
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.stderr.splitlines()[-1].startswith("ImportError: jaxlib 0.10.2 is installed"), result.stderr
