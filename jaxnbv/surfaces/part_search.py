"""Search for parts of known size, and their placements, that fit the scan.

Each part is tried in the same number of placements, and the best few are refined by Gauss-Newton steps on the misfit E
of `registration`. The best distinct results of each part are refined again on more points, together with the hypotheses
of the previous view. Then all parts are tried in each of the best placements so far, because the right placement of a
part may have been found only for a similar part. Until the final selection, every part keeps results of its own, so
similar parts that fit better do not displace it. The time grows linearly with the number of parts.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.geometry.volume import Box
from jaxnbv.programs import program
from jaxnbv.surfaces.part_evidence import Rays, evidence
from jaxnbv.surfaces.placement import Placement, ShapePoses
from jaxnbv.surfaces.registration import (
    FitTargets,
    Hypotheses,
    Prior,
    evaluate,
    flatten,
    join,
    keep_first,
    reevaluate,
    refine,
    similar_rotations,
)
from jaxnbv.surfaces.shape_bank import ShapeBank

NUM_HYPOTHESES = 32
# Number of positions tried for each rotation.
_NUM_POSITIONS = 4
# Starts per part, points and steps of the first and the second refinement. Number of placements that are tried with all
# parts. Steps of the last refinement.
_COARSE, _FINE, _NUM_SHARED, _LAST = (10, 48, 5), (4, 128, 10), 16, 3
# Before the last stage, placements with nearly equal rotations count as equal if their shifts differ by less than this,
# in scene units.
_MAX_SHIFT = 0.15
# How far a part may extend beyond the box, and the difference of signed distances below which placements of a part
# count as equal. Both are in scene units.
_MARGIN, TOLERANCE = 0.2, 0.03
_NUM_PROBES, _NUM_RAYS = 4096, 1024


def placeholder_hypotheses(dtype: Any) -> Hypotheses:
    """Return hypotheses of infinite misfit to use as the previous hypotheses at the first view.

    Each is the first part at the identity placement, which does no harm as an extra start of the search.
    """
    identity = Placement(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype), jnp.ones(3, dtype))
    one = Hypotheses(jnp.zeros((), int), identity, jnp.asarray(jnp.inf, dtype), jnp.asarray(False))
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (NUM_HYPOTHESES, *leaf.shape)), one)


@program
def search_parts(
    bank: ShapeBank,
    poses: ShapePoses,
    box: Box,
    targets: FitTargets,
    rays: Rays | None,
    previous: Hypotheses,
    num_starts: int,
) -> Hypotheses:
    """Return the 32 placed parts of smallest misfit, best first.

    The misfit is the L of `part_evidence`, or without rays the E of `registration`. If placements of a part have equal
    surfaces, for example by symmetry, all but the best get an infinite misfit.

    - `bank`: parts at true size, in scene units.
    - `previous`: the hypotheses of the previous view, which are refined and kept while they fit.
    - `num_starts`: number of placements tried for each part.
    """
    prior = Prior(poses, box, is_true_size=True)
    coarse_targets, fine_targets = targets.first(_COARSE[1]), targets.first(_FINE[1])
    starts = _group(evaluate(bank, prior, _starts(bank, prior, targets, num_starts), coarse_targets), len(bank))
    best = jax.vmap(lambda one: one.best(_COARSE[0]))(starts)
    coarse = refine(bank, prior, flatten(best), coarse_targets, _COARSE[2])
    fine = flatten(jax.vmap(lambda one: _keep_distinct(one, _FINE[0]))(_group(coarse, len(bank))))
    fine = refine(bank, prior, join(fine, previous), fine_targets, _FINE[2])
    placements = jax.tree.map(lambda rows: jnp.stack(len(bank) * [rows]), _keep_distinct(fine, _NUM_SHARED).placement)
    swaps = evaluate(bank, prior, placements, fine_targets)
    swaps = _group(reevaluate(bank, prior, swaps, fine_targets), len(bank))
    previous = jax.tree.map(lambda rows: rows[-NUM_HYPOTHESES:], fine)
    fine = jax.tree.map(lambda rows: rows[:-NUM_HYPOTHESES], fine)
    pool = join(_group(fine, len(bank)), swaps, axis=1)
    pool = jax.vmap(lambda one: _keep_distinct(one, _FINE[0]))(pool)
    last = refine(bank, prior, join(flatten(pool), previous), fine_targets, _LAST)
    if rays is None:
        last = reevaluate(bank, prior, last, targets)
    else:
        last = dataclasses.replace(last, misfit=evidence(bank, last, rays.first(_NUM_RAYS))[0])
    return _mark_repeats(bank, box, last.best(2 * NUM_HYPOTHESES)).best(NUM_HYPOTHESES)


def _group(hypotheses: Hypotheses, num_shapes: int) -> Hypotheses:
    """Split the axis of hypotheses in two: shapes, and the hypotheses of each shape.

    The hypotheses must be sorted by shape, with the same number for each shape.
    """
    return jax.tree.map(lambda rows: rows.reshape(num_shapes, -1, *rows.shape[1:]), hypotheses)


def _keep_distinct(hypotheses: Hypotheses, count: int) -> Hypotheses:
    """Return the best `count` hypotheses with distinct placements, regardless of their shapes.

    If there are fewer, the remaining rows have infinite misfit.
    """
    hypotheses = hypotheses.best(len(hypotheses.misfit))
    shift = hypotheses.placement.shift
    distances = jnp.linalg.norm(shift[:, None] - shift, axis=-1)
    is_distinct = keep_first(similar_rotations(hypotheses.placement.rotation) & (distances < _MAX_SHIFT))
    return dataclasses.replace(hypotheses, misfit=jnp.where(is_distinct, hypotheses.misfit, jnp.inf)).best(count)


def _starts(bank: ShapeBank, prior: Prior, targets: FitTargets, num_starts: int) -> Placement:
    """Return start placements (axis 1) of each shape (axis 0): rotations, each at a few positions.

    At the first position of a rotation, the side of the shape's bounding box that faces the sensor touches the scan,
    and the box is centred on the scan in the two directions across the line of sight. The other positions are spread
    over all positions at which the bounding box contains the scan (or, along an axis on which the box is shorter than
    the scan, lies within the scan). Positions at which the shape would leave `prior.box` by more than a margin are
    clipped.
    """
    dtype = targets.points.dtype
    rotations = jnp.asarray(prior.poses.rotations_of(len(bank), max(1, num_starts // _NUM_POSITIONS)), dtype)
    count = rotations.shape[1]
    # The positions after the first follow a low-discrepancy sequence (Roberts 2018).
    increments = np.array([0.8191725134, 0.6710436067, 0.5497004779])
    sequence = (0.5 + np.arange(1, count * (_NUM_POSITIONS - 1) + 1)[:, None] * increments) % 1.0
    first = np.tile([[[0.5, 0.5, 1.0]]], (1, count, 1))
    fractions = jnp.asarray(np.concatenate([first, sequence.reshape(_NUM_POSITIONS - 1, count, 3)]), dtype)

    axes = _axes_of_sight(targets)
    coordinates = jnp.matmul(targets.points, axes.T, precision="highest")
    scan_low = jnp.min(jnp.where(targets.mask[:, None], coordinates, jnp.inf), axis=0)
    scan_high = jnp.max(jnp.where(targets.mask[:, None], coordinates, -jnp.inf), axis=0)
    low, high = jnp.asarray(prior.box.low, dtype) - _MARGIN, jnp.asarray(prior.box.high, dtype) + _MARGIN

    def place(shape, rotation, fraction):
        extremes = jnp.matmul(shape.extremes, rotation.T, precision="highest")
        extents = jnp.matmul(extremes, axes.T, precision="highest")
        shift_high, shift_low = scan_high - jnp.max(extents, axis=0), scan_low - jnp.min(extents, axis=0)
        shift = jnp.matmul(shift_low + fraction * (shift_high - shift_low), axes, precision="highest")
        clipped = jnp.clip(shift, low - jnp.min(extremes, axis=0), high - jnp.max(extremes, axis=0))
        return Placement(rotation, clipped, jnp.ones(3, dtype))

    def place_shape(shape, shape_rotations):
        place_rotations = jax.vmap(place, (None, 0, 0))
        return flatten(jax.vmap(place_rotations, (None, None, 0))(shape, shape_rotations, fractions))

    all_rotations = jnp.broadcast_to(rotations, (len(bank), *rotations.shape[1:]))
    return jax.vmap(place_shape)(bank.shapes, all_rotations)


def _axes_of_sight(targets: FitTargets) -> Float[Array, "3 3"]:
    """Return unit vectors as rows: two across the line of sight, and one toward the sensor.

    The direction toward the sensor is taken to be that of the scan's mean normal.
    """
    mean = jnp.sum(jnp.where(targets.mask[:, None], targets.normals, 0.0), axis=0)
    length = jnp.linalg.norm(mean)
    normal = jnp.where(length > 0, mean / jnp.where(length > 0, length, 1.0), jnp.eye(3, dtype=mean.dtype)[2])
    tangent = jnp.cross(normal, jnp.eye(3, dtype=mean.dtype)[jnp.argmin(jnp.abs(normal))])
    tangent = tangent / jnp.linalg.norm(tangent)
    return jnp.stack([tangent, jnp.cross(normal, tangent), normal])


def _mark_repeats(bank: ShapeBank, box: Box, hypotheses: Hypotheses) -> Hypotheses:
    """Mark each hypothesis that has the same part and the same surface as an earlier hypothesis.

    A marked hypothesis has `is_distinct` False and infinite misfit. The hypotheses must be sorted, best first.
    """
    dtype = hypotheses.misfit.dtype
    low, high = jnp.asarray(box.low, dtype) - _MARGIN, jnp.asarray(box.high, dtype) + _MARGIN
    probes = low + (high - low) * jnp.asarray(np.random.default_rng(0).random((_NUM_PROBES, 3)), dtype)

    def distances(one):
        return one.placement.distance(bank.shape(one.shape).solid, probes)

    values = jax.lax.map(distances, hypotheses, batch_size=8)

    def gap(row):
        return jnp.max(jnp.abs(values - row), axis=1)

    is_same = (jax.lax.map(gap, values, batch_size=4) < TOLERANCE) & (hypotheses.shape[:, None] == hypotheses.shape)
    is_distinct = keep_first(is_same)
    return dataclasses.replace(
        hypotheses, is_distinct=is_distinct, misfit=jnp.where(is_distinct, hypotheses.misfit, jnp.inf)
    )
