"""Computation of a function within a compiled program, with the same bits as outside `jit`."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental.layout import Layout, with_layout_constraint
from jax.experimental.scheduling_groups import xla_metadata_call
from jax.extend.core import JaxprEqn, Literal

from jaxnbv.sharding import on_cpu


def in_parts(function: Callable[..., Any], *arguments: Any) -> Any:
    """Compute `function(*arguments)` under `jit`. On a CPU, the bits are the same as outside `jit`.

    Outside `jit`, each operation and each jitted function that `function` calls is a separate program. In a single
    program, XLA would fuse operations. Fusion changes the bits, because a fused product and sum are rounded only once.
    Therefore each operation becomes a call that XLA does not inline, and optimisation barriers around the call keep XLA
    from folding constants. On a GPU, bits are not reproducible anyway, so the function is called directly.
    """
    if not on_cpu():
        return function(*arguments)
    closed, shapes, static = eqx.filter_make_jaxpr(function)(*arguments)
    values: dict[Any, Any] = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
    values |= zip(closed.jaxpr.invars, jax.tree.leaves(eqx.filter(arguments, eqx.is_array)), strict=True)

    def value(atom: Any) -> Any:
        return jnp.asarray(atom.val, atom.aval.dtype) if isinstance(atom, Literal) else values[atom]  # type: ignore[attr-defined]

    for equation in closed.jaxpr.eqns:
        inputs = jax.lax.optimization_barrier([value(atom) for atom in equation.invars])
        outputs = xla_metadata_call(_part(equation), inlineable="false")(*inputs)
        values |= zip(equation.outvars, jax.lax.optimization_barrier(outputs), strict=True)
    arrays = jax.tree.unflatten(jax.tree.structure(shapes), [value(atom) for atom in closed.jaxpr.outvars])
    return eqx.combine(arrays, static)


def _part(equation: JaxprEqn) -> Callable[..., list[Any]]:
    """Return one equation of a jaxpr as a function of the equation's inputs."""

    def part(*inputs: Any) -> list[Any]:
        # Before JAX 0.12, get_bind_params returns functions too.
        bound = equation.primitive.get_bind_params(equation.params)
        functions, settings = bound if isinstance(bound, tuple) else ((), bound)
        with equation.ctx.manager:
            outputs = equation.primitive.bind(*functions, *map(_in_order, inputs), **settings)
        return [_in_order(output) for output in (outputs if equation.primitive.multiple_results else [outputs])]

    return part


def _in_order(array: Any) -> Any:
    """Constrain an array to row-major layout, which the arguments and results of a program have."""
    if array.ndim < 2 or jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return array
    return with_layout_constraint(array, Layout(tuple(range(array.ndim))))
