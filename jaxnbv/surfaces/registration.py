"""Search for known shapes and placements that fit the scan.

A shape with signed distance d and placement T has the misfit

    E = mean_j [ log(1 + d(x_j)^2 / 2 tau^2) + (1 - n_j . grad d(x_j)) / 2 ]
        + 2 mean_i log(1 + min(d(z_i) + margin, 0)^2 / tau^2) + prior(T)

for scanned points x_j with normals n_j, and points z_i that were seen to be empty. A point z_i counts if it is deeper
inside the shape than the margin of 0.05 scene units. Without the points z_i, shapes would shrink onto the visible
patch. prior(T) is a weak prior on shift and scale. All shapes are tried in many rotations. The hypotheses of smallest E
are refined by Gauss-Newton steps (iteratively reweighted least squares, with weights from the logarithms in E). During
these steps tau, the scale of the distances, falls from 0.12 to 0.03 scene units.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.geometry.cloud import farthest_point_subsample
from jaxnbv.geometry.volume import Box
from jaxnbv.observations import Observations
from jaxnbv.programs import program
from jaxnbv.surfaces.factor import CholeskyFactor
from jaxnbv.surfaces.placement import Placement, ShapePoses
from jaxnbv.surfaces.shape_bank import Shape, ShapeBank, values_and_gradients

NUM_POINTS, _NUM_EMPTY = 256, 512
_MARGIN = 0.05
_FIRST_TAU, _LAST_TAU = 0.12, 0.03
# Prior standard deviations of the shift (scene units) and of the logarithm of the scale, relative to the placement that
# fills the box, and the weight of this prior in E.
_SHIFT_DEVIATION, _STRETCH_DEVIATION, _PRIOR_WEIGHT = 0.2, 0.15, 0.02
# Number of hypotheses, points and steps in the first, the second and the last refinement.
_COARSE, _FINE, _LAST = (192, 48, 4), (48, 128, 8), (96, 128, 8)
# Number of placements that are tried with all shapes.
_NUM_SHARED = 4
_BATCH_SIZE = 256
_DAMPING = 1e-3
_MAX_STEP = 0.3


class FitTargets(NamedTuple):
    """Data to which shapes are fitted: points with normals, and empty points, in scene coordinates.

    The first rows alone cover the same region as all rows, more sparsely. `mask` and `is_empty` are False for padding.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    empty: Float[Array, "m 3"]
    is_empty: Bool[Array, " m"]

    @classmethod
    def of(cls, observations: Observations) -> "FitTargets":
        """Choose cloud points by farthest point sampling, and random nodes that are empty or in an obstacle."""
        cloud = farthest_point_subsample(observations.cloud, NUM_POINTS)
        empty, is_empty = _choose_empty_points(observations)
        return cls(cloud.points, cloud.normals, cloud.mask, empty.astype(cloud.points.dtype), is_empty)

    def first(self, count: int) -> "FitTargets":
        """Return the first `count` rows of each array."""
        return FitTargets(*(rows[:count] for rows in self))


def _choose_empty_points(observations: Observations) -> tuple[Float[Array, "m 3"], Bool[Array, " m"]]:
    if observations.empty_nodes is None or observations.grid is None:
        return jnp.zeros((_NUM_EMPTY, 3)), jnp.zeros(_NUM_EMPTY, bool)
    empty = observations.empty_nodes
    if observations.obstacle_nodes is not None:
        empty = empty | observations.obstacle_nodes
    order = np.random.default_rng(0).permutation(empty.size)
    node, is_empty = _first_empty_nodes(empty, order)
    return jnp.asarray(observations.grid.axis)[node], is_empty


@jax.jit
def _first_empty_nodes(
    empty_nodes: Bool[Array, "g g g"], order: Int[Array, " nodes"]
) -> tuple[Int[Array, "m 3"], Bool[Array, " m"]]:
    """Return grid indices of the first 512 empty nodes by `order` (flat indices), and a mask of filled rows."""
    is_empty = empty_nodes.reshape(-1)[order]
    row = jnp.where(is_empty, jnp.cumsum(is_empty) - 1, _NUM_EMPTY)
    indices = jnp.zeros(_NUM_EMPTY, jnp.int32).at[row].set(order, mode="drop")
    return jnp.stack(jnp.unravel_index(indices, empty_nodes.shape), axis=-1), jnp.arange(_NUM_EMPTY) < jnp.sum(is_empty)


class Hypotheses(eqx.Module):
    """Explanations of a scan: shapes of a bank, each with a placement.

    - `shape`: index of each shape in the bank.
    - `misfit`: E (see `surfaces/registration.py`), or L for parts with rays (see `surfaces/part_evidence.py`).
    - `is_distinct`: False if a better hypothesis has the same shape and nearly the same placement. In `register` this
      means rotations less than 15 degrees apart. In `search_parts` it means equal surfaces.
    """

    shape: Int[Array, "*h"]
    placement: Placement
    misfit: Float[Array, "*h"]
    is_distinct: Bool[Array, "*h"]

    def best(self, count: int) -> "Hypotheses":
        """Return the `count` hypotheses of smallest misfit, best first."""
        _, rows = jax.lax.top_k(-self.misfit, min(count, len(self.misfit)))
        return jax.tree.map(lambda leaf: leaf[rows], self)


class Prior(NamedTuple):
    """Prior over placements.

    - `box`: a box that the object approximately fills.
    - `is_true_size`: whether shapes are at true size. Then they keep their scale and need not fill the box.
    """

    poses: ShapePoses
    box: Box
    is_true_size: bool = False

    @property
    def step_basis(self) -> Float[np.ndarray, "9 k"]:
        """Basis, as columns, of the possible steps of `Placement.moved`, without scaling if at true size."""
        return self.poses.rigid_basis if self.is_true_size else self.poses.step_basis

    def fill_box(self, shape: Shape, rotation: Float[Array, "3 3"]) -> Placement:
        """Return the placement with this rotation at which the shape is centred in the box, as large as fits."""
        extremes = jnp.matmul(shape.extremes, rotation.T, precision="highest")
        low, high = jnp.min(extremes, axis=0), jnp.max(extremes, axis=0)
        box_low, box_high = jnp.asarray(self.box.low, extremes.dtype), jnp.asarray(self.box.high, extremes.dtype)
        scale = jnp.min((box_high - box_low) / (high - low))
        return Placement(rotation, 0.5 * (box_low + box_high) - 0.5 * scale * (low + high), jnp.broadcast_to(scale, 3))

    def deviation(self, shape: Shape, placement: Placement) -> Float[Array, "9"]:
        """Return the step of `Placement.moved` from `fill_box`, with the same rotation, to a placement.

        The step shifts and scales, but does not rotate. For shapes at true size it is zero.
        """
        if self.is_true_size:
            return jnp.zeros(9, placement.shift.dtype)
        reference = self.fill_box(shape, placement.rotation)
        shift, stretch = placement.shift - reference.shift, jnp.log(placement.scale / reference.scale)
        return jnp.concatenate([jnp.zeros_like(shift), shift, stretch])

    def clip_scale(self, shape: Shape, placement: Placement) -> Placement:
        """Return the placement with its scale clipped to the range of `ShapePoses.scale`."""
        if self.is_true_size:
            return placement
        reference = self.fill_box(shape, placement.rotation).scale
        low, high = self.poses.scale
        return eqx.tree_at(lambda p: p.scale, placement, jnp.clip(placement.scale, low * reference, high * reference))


_PRECISION = _PRIOR_WEIGHT * np.array([0.0] * 3 + [_SHIFT_DEVIATION**-2] * 3 + [_STRETCH_DEVIATION**-2 / 3.0] * 3)


@program
def register(bank: ShapeBank, prior: Prior, targets: FitTargets, num_starts: int) -> Hypotheses:
    """Return the shapes and placements that fit the scan best, best first.

    Each shape is tried in many rotations (`num_starts` for all shapes together), and the best hypotheses are refined.
    Then each shape is tried in the placements of a few refined hypotheses, and the best results are refined again.
    """
    coarse_targets, fine_targets = targets.first(_COARSE[1]), targets.first(_FINE[1])
    starts = _rotated_starts(bank, prior, coarse_targets, num_starts)
    coarse = refine(bank, prior, starts.best(_COARSE[0]), coarse_targets, _COARSE[2])
    fine = refine(bank, prior, coarse.best(_FINE[0]), fine_targets, _FINE[2])
    swaps = _swap_shapes(bank, prior, fine, coarse_targets).best(_LAST[0])
    last = refine(bank, prior, join(fine, swaps).best(_LAST[0]), fine_targets, _LAST[2])
    fits = reevaluate(bank, prior, last, targets).best(_LAST[0])
    return dataclasses.replace(fits, is_distinct=_find_distinct(fits.shape, fits.placement.rotation))


def _rotated_starts(bank: ShapeBank, prior: Prior, targets: FitTargets, num_starts: int) -> Hypotheses:
    """Compute the misfit of each shape in several rotations, scaled to fill the box."""
    all_rotations = jnp.asarray(prior.poses.rotations(num_starts), targets.points.dtype)
    count = max(1, min(len(all_rotations), num_starts // len(bank)))
    # Each shape gets evenly spaced rotations with its own offset, so that together the shapes try all rotations.
    offsets = np.random.default_rng(0).permutation(len(bank)) / len(bank)
    positions = (np.arange(count) + offsets[:, None]) * len(all_rotations) / count

    def fill_boxes(shape, rotations):
        return jax.vmap(lambda one: prior.fill_box(shape, one))(rotations)

    starts = jax.vmap(fill_boxes)(bank.shapes, all_rotations[positions.astype(int)])
    return evaluate(bank, prior, starts, targets)


def _swap_shapes(bank: ShapeBank, prior: Prior, hypotheses: Hypotheses, targets: FitTargets) -> Hypotheses:
    """Place each shape as in each of the best hypotheses with distinct rotations, and compute its misfit.

    The shape gets the hypothesis's rotation. Its shift and scale differ from those with which it would fill the box
    (`Prior.fill_box`) by as much as the hypothesis's do for the hypothesis's own shape.
    """
    hypotheses = hypotheses.best(len(hypotheses.misfit))
    is_distinct = _find_distinct(jnp.zeros_like(hypotheses.shape), hypotheses.placement.rotation)
    seeds = jax.tree.map(lambda leaf: leaf[jnp.argsort(~is_distinct, stable=True)[:_NUM_SHARED]], hypotheses)
    placements = seeds.placement
    steps = jax.vmap(lambda index, placement: prior.deviation(bank.shape(index), placement))(seeds.shape, placements)

    def place_shape(shape):
        return jax.vmap(lambda one, step: prior.fill_box(shape, one.rotation).moved(step))(placements, steps)

    return evaluate(bank, prior, jax.vmap(place_shape)(bank.shapes), targets)


def evaluate(bank: ShapeBank, prior: Prior, placements: Placement, targets: FitTargets) -> Hypotheses:
    """Compute the misfit E, at the first tau, of each shape (axis 0) at each of its placements (axis 1).

    The result has one axis, sorted by shape.
    """
    num_shapes, count = placements.scale.shape[:2]

    def misfits_of_shape(one):
        shape, shape_placements = one
        return jax.vmap(lambda placement: _misfit(shape, prior, placement, targets, _FIRST_TAU))(shape_placements)

    misfit = jax.lax.map(misfits_of_shape, (bank.shapes, placements), batch_size=max(1, _BATCH_SIZE // count))
    shape = jnp.repeat(jnp.arange(num_shapes), count)
    return Hypotheses(shape, flatten(placements), misfit.reshape(-1), jnp.ones(len(shape), bool))


def join(*parts: Hypotheses, axis: int = 0) -> Hypotheses:
    """Concatenate hypotheses along an axis."""
    return jax.tree.map(lambda *rows: jnp.concatenate(rows, axis), *parts)


def flatten(rows_of_shapes: Any) -> Any:
    """Merge the first two axes (shapes, and rows of a shape) of each array in a tree."""
    return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), rows_of_shapes)


def refine(bank: ShapeBank, prior: Prior, starts: Hypotheses, targets: FitTargets, num_steps: int) -> Hypotheses:
    """Refine each start by Gauss-Newton steps on the misfit E.

    tau, the scale of the distances in E (see the module docstring), is lowered from step to step. For each start, the
    result is the iterate whose E at the last tau is smallest.
    """
    taus = jnp.append(jnp.geomspace(_FIRST_TAU, _LAST_TAU, num_steps), _LAST_TAU)
    basis = jnp.asarray(prior.step_basis, targets.points.dtype)

    def refine_one(start):
        shape = bank.shape(start.shape)

        def advance(state, tau):
            current, best, smallest = state
            step, misfit = _newton_step(shape, prior, current, targets, tau, basis)
            best = jax.tree.map(lambda a, b: jnp.where(misfit < smallest, a, b), current, best)
            # E is computed before each step, so the placement after the last step has no E and is dropped.
            return (prior.clip_scale(shape, current.moved(step)), best, jnp.minimum(misfit, smallest)), None

        state = start.placement, start.placement, jnp.asarray(jnp.inf, targets.points.dtype)
        (_, best, smallest), _ = jax.lax.scan(advance, state, taus)
        return Hypotheses(start.shape, best, smallest, start.is_distinct)

    return jax.lax.map(refine_one, starts, batch_size=_BATCH_SIZE)


def reevaluate(bank: ShapeBank, prior: Prior, hypotheses: Hypotheses, targets: FitTargets) -> Hypotheses:
    """Return the hypotheses with the misfit E recomputed from all rows of `targets`, at the last tau."""

    def misfit(one):
        return _misfit(bank.shape(one.shape), prior, one.placement, targets, _LAST_TAU)

    return dataclasses.replace(hypotheses, misfit=jax.lax.map(misfit, hypotheses, batch_size=_BATCH_SIZE))


def _mean(values: Float[Array, " n"], mask: Bool[Array, " n"]) -> Float[Array, ""]:
    return jnp.sum(jnp.where(mask, values, 0.0)) / jnp.maximum(jnp.sum(mask), 1)


def _misfit(
    shape: Shape, prior: Prior, placement: Placement, targets: FitTargets, tau: Float[Array, ""] | float
) -> Float[Array, ""]:
    # One pass of `jax.jvp` computes all d(x_j) and n_j . grad d(x_j).
    distance, slope = jax.jvp(lambda x: placement.distance(shape.solid, x), (targets.points,), (targets.normals,))
    empty = placement.distance(shape.solid, targets.empty)
    return _sum_terms(distance, slope, empty, prior.deviation(shape, placement), targets, tau)


def _sum_terms(
    distance: Float[Array, " n"],
    slope: Float[Array, " n"],
    empty: Float[Array, " m"],
    deviation: Float[Array, "9"],
    targets: FitTargets,
    tau: Float[Array, ""] | float,
) -> Float[Array, ""]:
    data_terms = jnp.log1p(distance**2 / (2.0 * tau**2)) + 0.5 * (1.0 - jnp.clip(slope, -1.0, 1.0))
    empty_terms = jnp.log1p(jnp.minimum(empty + _MARGIN, 0.0) ** 2 / tau**2)
    prior_term = 0.5 * jnp.sum(jnp.asarray(_PRECISION, deviation.dtype) * deviation**2)
    return _mean(data_terms, targets.mask) + 2.0 * _mean(empty_terms, targets.is_empty) + prior_term


def _newton_step(
    shape: Shape,
    prior: Prior,
    placement: Placement,
    targets: FitTargets,
    tau: Float[Array, ""],
    basis: Float[Array, "9 k"],
) -> tuple[Float[Array, "9"], Float[Array, ""]]:
    """Return a damped Gauss-Newton step of limited size, and the misfit E of `placement` at the last tau.

    In place of E's term for a normal n, the step minimises |n - grad d|^2 / 4. See `ShapePoses.step_basis` for `basis`.
    """
    points = jnp.concatenate([targets.points, targets.empty])
    distance, gradient = values_and_gradients(lambda x: placement.distance(shape.solid, x), points)
    count = len(targets.points)
    # Derivatives of the distance at fixed points of the scene with respect to a rotation of the shape about t, its
    # shift, and the logarithm of its scale.
    arms = points - placement.shift
    local_arms = jnp.matmul(arms, placement.rotation, precision="highest")
    local_gradient = jnp.matmul(gradient, placement.rotation, precision="highest")
    scale_rows = distance[:, None] / 3.0 - local_arms * local_gradient
    rows = jnp.concatenate([jnp.cross(gradient, arms), -gradient, scale_rows], axis=1)
    rows = jnp.matmul(rows, basis, precision="highest")

    data_weights = jnp.where(targets.mask, 1.0, 0.0) / jnp.maximum(jnp.sum(targets.mask), 1)
    empty_weights = jnp.where(targets.is_empty, 4.0, 0.0) / jnp.maximum(jnp.sum(targets.is_empty), 1)
    depth = jnp.minimum(distance[count:] + _MARGIN, 0.0)
    residuals = jnp.concatenate([distance[:count], depth])
    weights = jnp.concatenate(
        [
            data_weights / (tau**2 + 0.5 * distance[:count] ** 2),
            jnp.where(depth < 0, empty_weights, 0.0) / (tau**2 + depth**2),
        ]
    )

    # On flat parts of the surface, a small rotation omega of the shape changes the gradient by omega x gradient.
    length = jnp.maximum(jnp.linalg.norm(gradient[:count], axis=1, keepdims=True), 1e-6)
    unit = gradient[:count] / length
    normal_rows = jnp.cross(jnp.eye(3, dtype=unit.dtype), unit[:, None])
    normal_rows = jnp.einsum("nad,ak->ndk", normal_rows, basis[:3], precision="highest")
    precision, deviation = jnp.asarray(_PRECISION, rows.dtype), prior.deviation(shape, placement)

    matrix = jnp.einsum("n,nk,nl->kl", weights, rows, rows, precision="highest")
    matrix = matrix + 0.5 * jnp.einsum("n,ndk,ndl->kl", data_weights, normal_rows, normal_rows, precision="highest")
    matrix = matrix + jnp.matmul(basis.T, precision[:, None] * basis, precision="highest")
    vector = jnp.einsum("n,n,nk->k", weights, residuals, rows, precision="highest")
    vector = vector - 0.5 * jnp.einsum(
        "n,nd,ndk->k", data_weights, targets.normals - unit, normal_rows, precision="highest"
    )
    vector = vector + jnp.matmul(basis.T, precision * deviation, precision="highest")

    matrix = matrix + _DAMPING * jnp.trace(matrix) * jnp.eye(len(matrix), dtype=matrix.dtype)
    step = jnp.matmul(basis, CholeskyFactor.of(matrix).solve(-vector), precision="highest")
    agreement = jnp.sum(targets.normals * gradient[:count], axis=1)
    misfit = _sum_terms(distance[:count], agreement, distance[count:], deviation, targets, _LAST_TAU)
    return step * jnp.minimum(1.0, _MAX_STEP / jnp.maximum(jnp.max(jnp.abs(step)), 1e-9)), misfit


def _find_distinct(shape: Int[Array, " h"], rotation: Float[Array, "h 3 3"]) -> Bool[Array, " h"]:
    """Return a mask that drops a hypothesis if a better one with its shape, within 15 degrees, is kept.

    The hypotheses must be sorted, best first.
    """
    return keep_first(similar_rotations(rotation) & (shape[:, None] == shape))


def similar_rotations(rotation: Float[Array, "h 3 3"]) -> Bool[Array, "h h"]:
    """Return, for each pair of rotations, whether the two differ by less than 15 degrees."""
    trace = jnp.einsum("aij,bij->ab", rotation, rotation, precision="highest")
    return 0.5 * (trace - 1.0) > np.cos(np.radians(15.0))


def keep_first(is_same: Bool[Array, "h h"]) -> Bool[Array, " h"]:
    """Return a mask that keeps a row unless `is_same` pairs it with an earlier row that is kept."""
    order = jnp.arange(is_same.shape[0])

    def keep(is_first, index):
        is_repeat = jnp.any(is_same[index] & is_first & (order < index))
        return is_first.at[index].set(~is_repeat), None

    return jax.lax.scan(keep, jnp.zeros(len(order), bool), order)[0]
