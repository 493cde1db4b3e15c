"""Samples and candidates shared among devices.

    with jax.set_mesh(jax.sharding.Mesh(jax.devices(), "devices")):
        proposal = planner.propose(observations, key)

What is computed for each sample is computed for an equal share of them on each device; so is what is computed for each
candidate where samples are fewer than devices. Values are those of one device but for the order of sums. Axes that JAX
does not shard by itself (`AxisType.Explicit`, or of a `shard_map` around this) are left to who has set them.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import AxisType, PartitionSpec, get_abstract_mesh


def shared_map(function: Callable[..., Any], rows: Any, *common: Any, at_once: int = 1) -> Any:
    """`function(row, *common)` for each row of a tree, as `jax.lax.map`, with a share of the rows on each device.

    - `at_once`: rows that a device takes together.
    """

    def each(share: Any, *common: Any) -> Any:
        return batched_map(lambda row: function(row, *common), share, at_once)

    return shared(each, rows, *common)


def batched_map(function: Callable[..., Any], rows: Any, at_once: int) -> Any:
    """`jax.lax.map`, so many rows together, or one by one: XLA takes half as long again for a batch of one."""
    return jax.lax.map(function, rows, batch_size=at_once if at_once > 1 else None)


def shared(function: Callable[..., Any], rows: Any, *common: Any) -> Any:
    """`function(rows, *common)`, which treats all leading rows alike, with a share of them on each device, and the
    result on all of them. Where devices are more than rows, all rows are computed on each.

    The function gets all arrays as arguments: those that it closes over do not reach the devices.
    """
    axes, devices = _axes()
    count = len(jax.tree.leaves(rows)[0])
    if devices == 1 or count < devices:
        return function(rows, *common)
    # The last devices take some of the first rows again where they do not come out even.
    rows = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[: -count % devices]]), rows)
    arrays, rest = eqx.partition((rows, common), eqx.is_array)

    def on_each(share: Any, common: Any) -> Any:
        share, common = eqx.combine((share, common), rest)
        return jax.tree.map(lambda leaf: jax.lax.all_gather(leaf, axes, tiled=True), function(share, *common))

    specs, whole = (PartitionSpec(axes), PartitionSpec()), PartitionSpec()
    everywhere = jax.shard_map(on_each, in_specs=specs, out_specs=whole, axis_names=set(axes), check_vma=False)
    return jax.tree.map(lambda leaf: leaf[:count], everywhere(*arrays))


def share_of(count: int) -> int:
    """How many of so many rows each device takes."""
    _, devices = _axes()
    return count if count < devices else -(-count // devices)


def on_cpu() -> bool:
    """Whether programs run on the CPU: `jax_default_device` says so, or else what JAX found."""
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    return (jax.default_backend() if device is None else getattr(device, "platform", device)) == "cpu"


def _axes() -> tuple[tuple[str, ...], int]:
    """Axes of the mesh over which rows are shared, and how many devices they are."""
    mesh = get_abstract_mesh()
    sizes = {
        name: size
        for name, size, kind in zip(mesh.axis_names, mesh.axis_sizes, mesh.axis_types, strict=True)
        if kind == AxisType.Auto
    }
    return tuple(sizes), math.prod(sizes.values())
