"""First zeros of a trilinear interpolant f along rays.

A ray marches to the cell that holds its first zero. The zero is then the root of a cubic within the cell. Coordinates
are grid coordinates: the nodes lie at the integers 0, ..., g - 1 along every axis. A batch of n vectors is a list of
three components (n,). The first zero of a ray is the first point at which the sign of f differs from its sign at the
start of the ray. The value zero counts as negative.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8

from jaxnbv.geometry.volume import ray_interval
from jaxnbv.scanning.cubic import CORNERS, cubic, first_bracket, first_root
from jaxnbv.scanning.scanner import implicit_depth

# Once at most a fifth of the rays of a march is unfinished, the march continues with these rays only. Each batch size
# takes most of a second to compile, so small batches are not reduced further.
_SHRINK_FACTOR = 5
_MIN_BATCH = 4000

# A ray grazes the surface if the slope of f along the ray, per cell, is below this fraction of the spread of f over the
# cell's corners.
_MIN_SLOPE_RATIO = 0.03

# The x, y and z components of n vectors as three arrays, which XLA fuses better than one.
Triple = list[Float[Array, " n"]]


class March(NamedTuple):
    """State of a march along rays entry + t direction.

    - `entry`: point at which each ray enters the grid's box.
    - `t`: the ray's current position.
    - `t_end`: t at which the ray leaves the box. Once the ray has reached a cell with a zero, it is the t at which the
      ray leaves this cell. So if t < t_end after the march, there is a zero between t and t_end.
    - `sign`: sign of f at the start; zero until it has been computed.
    - `is_unfinished`: whether the ray has neither reached the cell of its first zero nor left the box.
    """

    entry: Triple
    direction: Triple
    t: Float[Array, " n"]
    t_end: Float[Array, " n"]
    sign: Int8[Array, " n"]
    is_unfinished: Bool[Array, " n"]


class GridField(eqx.Module):
    """A function f on a grid, and the distance from each cell of the grid to a change of sign of f.

    - `values`: f at the g^3 nodes, flattened in row-major order.
    - `cell_distance`: `free_distance` of the (g - 1)^3 cells, flattened in the same way.
    """

    values: Float[Array, " nodes"]
    cell_distance: Int8[Array, " cells"]
    resolution: int = eqx.field(static=True)

    @property
    def offset(self) -> float:
        """How far a position is moved with the ray, in cells along each axis, before its cell is looked up.

        The offset exceeds the rounding of coordinates, so a ray on the border of two cells is always assigned to the
        cell that it enters, and the march cannot stall. A zero in the skipped sliver is still detected, because the
        sign in the next cell then differs from the sign at the start.
        """
        return 16 * float(jnp.finfo(self.values.dtype).eps) * self.resolution


def free_distance(values: Float[Array, "g g g"]) -> Int8[Array, "m m m"]:
    """Return the signed distance, in cells, from each cell of a grid to the nearest change of sign of f.

    The distance is 0 for a cell whose own corners differ in sign. Otherwise it has the sign of f in the cell, and its
    magnitude (1, 2, 3, 5, 9 or 17) is a lower bound on the Chebyshev distance to the nearest change of sign.
    """
    maximum = functools.partial(
        jax.lax.reduce_window, init_value=jnp.int8(-1), computation=jax.lax.max, window_strides=(1, 1, 1)
    )
    positive = (values > 0).astype(jnp.int8)
    high = maximum(positive, window_dimensions=(2, 2, 2), padding="VALID")
    low = -maximum(-positive, window_dimensions=(2, 2, 2), padding="VALID")
    near = high - low
    distance = 1 - near
    for step in (1, 1, 2, 4, 8):
        # `near` has already grown by at least step - 1 cells, so its maximum over {-step, 0, step} leaves no hole.
        for axis in range(3):
            window, dilation, padding = [1, 1, 1], [1, 1, 1], [(0, 0)] * 3
            window[axis], dilation[axis], padding[axis] = 3, step, (step, step)
            near = maximum(near, window_dimensions=window, window_dilation=dilation, padding=padding)
        distance = distance + jnp.int8(step) * (1 - near)
    return jnp.where(low > 0, distance, -distance)


class _InCell(eqx.Module):
    """The trilinear function of one fixed cell per ray, at positions t on the rays u + t du."""

    field: GridField
    u: Triple
    du: Triple
    cell: list[Int[Array, " n"]]

    def __call__(self, t: Float[Array, " n"]) -> Float[Array, " n"]:
        local = [x + t * d - c for x, d, c in zip(self.u, self.du, self.cell, strict=True)]
        return cubic(corner_values(self.cell, self.field), local, self.du)[0]

    @property
    def least_slope(self) -> Float[Array, " n"]:
        corners = corner_values(self.cell, self.field)
        spread = functools.reduce(jnp.maximum, corners) - functools.reduce(jnp.minimum, corners)
        return _MIN_SLOPE_RATIO * spread * jnp.sqrt(sum(d * d for d in self.du))


def first_zero(field: GridField, u: Triple, du: Triple) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Return the position t of the first zero of f on each ray u + t du, and whether there is a zero.

    A ray starts at its origin u or, if u is outside the grid's box, where it enters the box. t is differentiable in the
    values of the field and in the rays. If a ray grazes the surface, its derivative uses a larger slope of f, see
    `implicit_depth`. If there is no zero, t and its derivatives are zero.
    """
    t, mask, cell = _traced_zero(*jax.lax.stop_gradient((field, u, du)))
    field_along_ray = _InCell(field, u, du, cell)
    return implicit_depth(field_along_ray, t, mask, jax.lax.stop_gradient(field_along_ray.least_slope)), mask


def _first_zero(field: GridField, u: Triple, du: Triple):
    """Return the results of `first_zero`, without their derivatives, and the cell of each zero."""
    rays, start = enter(u, du, field)
    rays = march(rays, field)
    mask = rays.t < rays.t_end
    rays = rays._replace(t=jnp.where(mask, rays.t, 0.0), t_end=jnp.where(mask, rays.t_end, 0.0))
    local, cell = cell_at(rays, field)
    width = rays.t_end - rays.t
    coefficients = cubic(corner_values(cell, field), local, [d * width for d in rays.direction])
    root = first_root([c * rays.sign for c in coefficients])
    return jnp.where(mask, start + rays.t + root * width, 0.0), mask, cell


_traced_zero = jax.custom_batching.custom_vmap(_first_zero)


@_traced_zero.def_vmap
def _traced_zero_batched(size: int, batched, field: GridField, u: list[Array], du: list[Array]):
    """Rule for `vmap` of `_traced_zero`: trace all rays as one batch if they share one field."""
    u, du = jax.tree.map(
        lambda x, is_batched: x if is_batched else jnp.broadcast_to(x, (size, *x.shape)), (u, du), tuple(batched[1:])
    )
    if any(jax.tree.leaves(batched[0])):
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched[0])
        zeros = jax.vmap(_first_zero, in_axes=(axes, 0, 0))(field, u, du)
    else:
        flat = jax.tree.map(lambda x: x.reshape(-1), (u, du))
        zeros = jax.tree.map(lambda x: x.reshape(size, -1), _traced_zero(field, *flat))
    return zeros, jax.tree.map(lambda _: True, zeros)


def smooth_gradient(field: GridField, x: Triple) -> Triple:
    """Return a continuous gradient of f, in change per cell, at points x within the grid.

    It is interpolated linearly from central differences at the nodes, or from one-sided differences on the border. The
    gradient of the trilinear interpolant itself would jump between cells.
    """
    last = field.resolution - 1
    cell = [jnp.clip(jnp.floor(jax.lax.stop_gradient(p)).astype(jnp.int32), 0, last - 1) for p in x]
    local = [p - c for p, c in zip(x, cell, strict=True)]
    index = [{offset: jnp.clip(c + offset, 0, last) for offset in (-1, 0, 1, 2)} for c in cell]

    @functools.cache
    def value(i, j, k):
        return _take(field.values, _flat([index[0][i], index[1][j], index[2][k]], field.resolution))

    gradient = []
    for axis in range(3):
        total = jnp.zeros_like(x[axis])
        for node in CORNERS:
            next_node, previous_node = ([n + step * (a == axis) for a, n in enumerate(node)] for step in (1, -1))
            width = index[axis][next_node[axis]] - index[axis][previous_node[axis]]
            weight = functools.reduce(jnp.multiply, [p if n else 1.0 - p for p, n in zip(local, node, strict=True)])
            total += weight * (value(*next_node) - value(*previous_node)) / width
        gradient.append(total)
    return gradient


def enter(u: Triple, du: Triple, field: GridField) -> tuple[March, Float[Array, " n"]]:
    """Return a march with t = 0 where each ray u + s du enters, or starts in, the grid's box, and this s."""
    # The box is smaller than the grid by a sliver, so that no position lies outside the grid after it is rounded and
    # moved forward.
    low, high = 2 * field.offset, field.resolution - 1 - 2 * field.offset
    du = [jnp.where(jnp.abs(d) < 1e-9, 1e-9, d) for d in du]
    start, end = ray_interval(u, du, 3 * [low], 3 * [high])
    start = jnp.maximum(start, 0.0)
    u = [jnp.clip(x + start * d, low, high) for x, d in zip(u, du, strict=True)]
    sign = jnp.zeros(start.shape, jnp.int8)
    return March(u, du, jnp.zeros_like(start), end - start, sign, start < end), start


def march(rays: March, field: GridField) -> March:
    """March all rays to the cell of their first zero, or out of the box (see `March.t_end`)."""
    count = rays.t.size
    remainder = count // _SHRINK_FACTOR if count > _MIN_BATCH else 0
    rays = jax.lax.while_loop(
        lambda rays: jnp.sum(rays.is_unfinished) > remainder,
        lambda rays: _search_cell(_stride(rays, field), field),
        rays,
    )
    if remainder == 0:
        return rays
    index = jnp.nonzero(rays.is_unfinished, size=remainder, fill_value=count)[0]
    rest = jax.tree.map(lambda leaf: jnp.take(leaf, index, mode="clip"), rays)
    rest = march(rest._replace(is_unfinished=index < count), field)

    def merge(array: Array, part: Array) -> Array:
        return array.at[index].set(part, mode="drop", unique_indices=True)

    return rays._replace(t=merge(rays.t, rest.t), t_end=merge(rays.t_end, rest.t_end), sign=merge(rays.sign, rest.sign))


def _stride(rays: March, field: GridField) -> March:
    """Move rays until most have reached a cell in which the sign changes, or have left the grid's box."""

    def step(state):
        rays, _ = state
        _, cell = cell_at(rays, field)
        distance = _take(field.cell_distance, _flat(cell, field.resolution - 1))
        sign = jnp.where(rays.sign == 0, jnp.sign(distance), rays.sign)
        is_free = rays.is_unfinished & (distance * sign > 0)
        t_leave = _t_leave(rays, cell, jnp.abs(distance).astype(jnp.int32) - 1)
        t = jnp.where(is_free, t_leave, rays.t)
        is_unfinished = rays.is_unfinished & (t < rays.t_end)
        return rays._replace(t=t, sign=sign, is_unfinished=is_unfinished), is_free & is_unfinished

    max_moving = rays.t.size // 8
    return jax.lax.while_loop(
        lambda state: jnp.sum(state[1]) > max_moving, step, (rays, jnp.ones_like(rays.is_unfinished))
    )[0]


def _search_cell(rays: March, field: GridField) -> March:
    """Stop each ray whose cell holds its first zero. Move other rays out of a cell with a sign change."""
    local, cell = cell_at(rays, field)
    distance = _take(field.cell_distance, _flat(cell, field.resolution - 1))
    has_sign_change = rays.is_unfinished & (distance * rays.sign <= 0)
    t_leave = jnp.minimum(_t_leave(rays, cell, 0), rays.t_end)
    coefficients = cubic(corner_values(cell, field), local, [d * (t_leave - rays.t) for d in rays.direction])
    sign = jnp.where(rays.sign == 0, jnp.where(coefficients[0] > 0, 1, -1).astype(jnp.int8), rays.sign)
    _, has_zero = first_bracket([c * sign for c in coefficients])
    has_zero = has_zero & has_sign_change
    t_end = jnp.where(has_zero, t_leave, rays.t_end)
    t = jnp.where(has_sign_change & ~has_zero, t_leave, rays.t)
    return rays._replace(
        t=t,
        t_end=t_end,
        sign=jnp.where(has_sign_change, sign, rays.sign),
        is_unfinished=rays.is_unfinished & ~has_zero & (t < t_end),
    )


def cell_at(rays: March, field: GridField) -> tuple[Triple, list[Int[Array, " n"]]]:
    """Return each ray's position within its cell, in [0, 1]^3, and the index of this cell.

    On the border of two cells, it is the cell ahead.
    """
    position = [x + rays.t * d for x, d in zip(rays.entry, rays.direction, strict=True)]
    cell = [
        jnp.floor(x + jnp.where(d > 0, field.offset, -field.offset)).astype(jnp.int32)
        for x, d in zip(position, rays.direction, strict=True)
    ]
    return [x - c for x, c in zip(position, cell, strict=True)], cell


def _t_leave(rays: March, cell: list[Int[Array, " n"]], cells) -> Float[Array, " n"]:
    """Return the t at which each ray leaves a cube: its `cell` and `cells` more cells to each side."""
    sides = [c + jnp.where(d > 0, cells + 1, -cells) for c, d in zip(cell, rays.direction, strict=True)]
    ends = [(side - x) / d for side, x, d in zip(sides, rays.entry, rays.direction, strict=True)]
    return functools.reduce(jnp.minimum, ends)


def _flat(index: list[Int[Array, " n"]], side: int) -> Int[Array, " n"]:
    return (index[0] * side + index[1]) * side + index[2]


def corner_values(cell: list[Int[Array, " n"]], field: GridField) -> list[Float[Array, " n"]]:
    """Return the values at the corners of cells, in the order of `CORNERS`."""
    base = _flat(cell, field.resolution)
    return [_take(field.values, base + ((i * field.resolution + j) * field.resolution + k)) for i, j, k in CORNERS]


def _take(array: Array, index: Int[Array, " n"]) -> Array:
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
