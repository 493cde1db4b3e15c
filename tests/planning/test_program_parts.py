"""Parts of a program have the same bits as separate programs, with XLA's optimisations on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.planning.program_parts import in_parts

COMPUTES = True
pytestmark = pytest.mark.as_users
X, Y, Z = jax.random.normal(jax.random.key(0), (3, 500, 3))


@jax.jit
def turned(x, y):
    """The layout within the program is by columns."""
    return jnp.stack([x[:, 0] * y[:, 1], x[:, 1] / 3.0, jnp.exp(y[:, 2])]).T


@jax.jit
def lengths(x):
    return jnp.sqrt(jnp.sum(x * x * 0.3 + x, axis=-1) ** 2 + jnp.sum(x * x, axis=-1))


def chain(x, y, z):
    """When fused, a product and a sum are rounded once."""
    return lengths(turned(x * y + z, y)) * x[:, 0] + z[:, 0] / 3.0


@pytest.mark.parametrize("compiled", [jax.jit, lambda f: lambda *a: jax.jit(jax.vmap(f))(*(x[None] for x in a))[0]])
def test_a_program_has_the_bits_of_its_parts(compiled):
    result = compiled(lambda *arrays: in_parts(chain, *arrays))(X, Y, Z)
    np.testing.assert_array_equal(result, chain(X, Y, Z))


def test_what_does_not_change_in_a_loop_keeps_its_bits():
    """XLA would move the product out of the loop and round it by itself."""
    step = jax.jit(lambda total, x, y: x * y + total)

    def add(index, total):
        return in_parts(step, total, X, Y)

    result = jax.jit(lambda: jax.lax.fori_loop(0, 4, add, Z))()
    expected = Z
    for _ in range(4):
        expected = step(expected, X, Y)
    np.testing.assert_array_equal(result, expected)


def test_other_types_than_arrays_pass():
    part = eqx.filter_jit(lambda pair: in_parts(lambda p: (p[0] + 1, p[1], None), pair))
    result = part((X, "name"))
    assert result[1:] == ("name", None)
    np.testing.assert_array_equal(result[0], X + 1)
