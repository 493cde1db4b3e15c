"""Search for parts of known size, and their placements, that fit the scan.

Each part is tried in the same number of placements, and its best few placements are refined by Gauss-Newton steps on
the misfit E of `registration`. The best distinct results of each part are refined again on more points, together with
the hypotheses of the previous view. Finally all parts are tried in each of the best placements so far. The search keeps
results for every part, so similar parts cannot displace a part. The last stage also tries a part in placements that
were reached only by similar parts. The time grows linearly with the number of parts.
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
    first_of_each,
    reevaluate,
    refine,
    turned_alike,
)
from jaxnbv.surfaces.shape_bank import ShapeBank

NUM_HYPOTHESES = 32
# Number of positions tried for each rotation.
_PLACES = 4
# Starts per part, points and steps, for the first and for the second refinement; number of placements tried with all
# parts; steps of the last refinement.
_COARSE, _FINE, _SHARED, _LAST = (10, 48, 5), (4, 128, 10), 16, 3
# Before the last stage, placements with nearly equal rotations count as equal if their shifts differ by less than this,
# in scene units.
_MOVE = 0.15
# How far a part may extend beyond the box, and the difference of surfaces below which placements of a part count as
# equal, in scene units.
_ROOM, SAME = 0.2, 0.03
_NUM_PROBES, _FEW_RAYS = 4096, 1024


def placeholder_hypotheses(dtype: Any) -> Hypotheses:
    """Return placeholders for the hypotheses of the view before the first.

    Each placeholder is the first part at the identity placement with infinite misfit. As an extra start of the search,
    it does no harm.
    """
    still = Placement(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype), jnp.ones(3, dtype))
    one = Hypotheses(jnp.zeros((), int), still, jnp.asarray(jnp.inf, dtype), jnp.asarray(False))
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
    - `poses`, `box`: the possible placements of the parts, and a box around the object.
    - `targets`, `rays`: points and rays of the views so far.
    - `previous`: the hypotheses of the previous view, which are refined and kept while they fit.
    - `num_starts`: number of placements tried for each part.
    """
    prior = Prior(poses, box, is_true_size=True)
    few, some = targets.first(_COARSE[1]), targets.first(_FINE[1])
    starts = _of_each(evaluate(bank, prior, _starts(bank, prior, targets, num_starts), few), len(bank))
    best = jax.vmap(lambda own: own.best(_COARSE[0]))(starts)
    coarse = refine(bank, prior, _flat(best), few, _COARSE[2])
    fine = _flat(jax.vmap(lambda own: _apart(own, _FINE[0]))(_of_each(coarse, len(bank))))
    fine = refine(bank, prior, jax.tree.map(lambda *rows: jnp.concatenate(rows), fine, previous), some, _FINE[2])
    everywhere = jax.tree.map(lambda rows: jnp.stack(len(bank) * [rows]), _apart(fine, _SHARED).placement)
    exchanged = _of_each(reevaluate(bank, prior, evaluate(bank, prior, everywhere, some), some), len(bank))
    own = jax.tree.map(lambda rows: rows[:-NUM_HYPOTHESES], fine)
    kept = jax.tree.map(lambda rows: rows[-NUM_HYPOTHESES:], fine)
    both = jax.tree.map(lambda *rows: jnp.concatenate(rows, axis=1), _of_each(own, len(bank)), exchanged)
    both = jax.vmap(lambda each: _apart(each, _FINE[0]))(both)
    last = refine(bank, prior, jax.tree.map(lambda *rows: jnp.concatenate(rows), _flat(both), kept), some, _LAST)
    if rays is None:
        last = reevaluate(bank, prior, last, targets)
    else:
        last = dataclasses.replace(last, misfit=evidence(bank, last, rays.first(_FEW_RAYS))[0])
    return _distinct(bank, box, last.best(2 * NUM_HYPOTHESES)).best(NUM_HYPOTHESES)


def _of_each(hypotheses: Hypotheses, num_shapes: int) -> Hypotheses:
    """Reshape hypotheses to a first axis of shapes, and a second axis of the hypotheses of one shape.

    The hypotheses must be sorted by shape, with the same number for each shape.
    """
    return jax.tree.map(lambda rows: rows.reshape(num_shapes, -1, *rows.shape[1:]), hypotheses)


def _flat(hypotheses: Hypotheses) -> Hypotheses:
    return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), hypotheses)


def _apart(hypotheses: Hypotheses, count: int) -> Hypotheses:
    """Return the best `count` hypotheses with distinct placements, regardless of their shapes.

    If there are fewer distinct placements, the remaining rows are hypotheses with infinite misfit.
    """
    ordered = hypotheses.best(len(hypotheses.misfit))
    shift = ordered.placement.shift
    moved = jnp.linalg.norm(shift[:, None] - shift, axis=-1)
    modes = first_of_each(turned_alike(ordered.placement.rotation) & (moved < _MOVE))
    return dataclasses.replace(ordered, misfit=jnp.where(modes, ordered.misfit, jnp.inf)).best(count)


def _starts(bank: ShapeBank, prior: Prior, targets: FitTargets, num_starts: int) -> Placement:
    """Return start placements (axis 1) of each shape (axis 0): rotations, each at a few positions.

    At each position the bounding box of the shape contains the scan, if the box is large enough. The first position of
    a rotation centres the scan across the line of sight, and puts it on the shape's front. The other positions are
    spread over all positions that contain the scan, so they differ much if the scan is a small patch of the shape.
    """
    dtype = targets.points.dtype
    rotations = jnp.asarray(prior.poses.rotations_of(len(bank), max(1, num_starts // _PLACES)), dtype)
    count = rotations.shape[1]
    # A low-discrepancy sequence (Roberts 2018). The first position centres the scan and puts it on the shape's front.
    steps = np.array([0.8191725134, 0.6710436067, 0.5497004779])
    spread = (0.5 + np.arange(1, count * (_PLACES - 1) + 1)[:, None] * steps) % 1.0
    middle = np.tile([[[0.5, 0.5, 1.0]]], (1, count, 1))
    shares = jnp.asarray(np.concatenate([middle, spread.reshape(_PLACES - 1, count, 3)]), dtype)

    axes = _axes_of_sight(targets)
    along = jnp.matmul(targets.points, axes.T, precision="highest")
    least = jnp.min(jnp.where(targets.mask[:, None], along, jnp.inf), axis=0)
    most = jnp.max(jnp.where(targets.mask[:, None], along, -jnp.inf), axis=0)
    low, high = jnp.asarray(prior.box.low, dtype) - _ROOM, jnp.asarray(prior.box.high, dtype) + _ROOM

    def place(shape, rotation, share):
        turned = jnp.matmul(shape.extremes, rotation.T, precision="highest")
        own = jnp.matmul(turned, axes.T, precision="highest")
        first, last = most - jnp.max(own, axis=0), least - jnp.min(own, axis=0)
        shift = jnp.matmul(last + share * (first - last), axes, precision="highest")
        inside = jnp.clip(shift, low - jnp.min(turned, axis=0), high - jnp.max(turned, axis=0))
        return Placement(rotation, inside, jnp.ones(3, dtype))

    def of_shape(shape, own_rotations):
        of_share = jax.vmap(place, (None, 0, 0))
        places = jax.vmap(of_share, (None, None, 0))(shape, own_rotations, shares)
        return jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), places)

    each = jnp.broadcast_to(rotations, (len(bank), *rotations.shape[1:]))
    return jax.vmap(of_shape)(bank.shapes, each)


def _axes_of_sight(targets: FitTargets) -> Float[Array, "3 3"]:
    """Return as rows two directions across the line of sight, and the mean normal, which faces the sensor."""
    mean = jnp.sum(jnp.where(targets.mask[:, None], targets.normals, 0.0), axis=0)
    length = jnp.linalg.norm(mean)
    ahead = jnp.where(length > 0, mean / jnp.where(length > 0, length, 1.0), jnp.eye(3, dtype=mean.dtype)[2])
    aside = jnp.cross(ahead, jnp.eye(3, dtype=mean.dtype)[jnp.argmin(jnp.abs(ahead))])
    aside = aside / jnp.linalg.norm(aside)
    return jnp.stack([aside, jnp.cross(ahead, aside), ahead])


def _distinct(bank: ShapeBank, box: Box, hypotheses: Hypotheses) -> Hypotheses:
    """Mark each hypothesis that has the same surface as a better hypothesis of the same part.

    Returns all hypotheses. Those marked have `is_mode` False and an infinite misfit. The hypotheses must be sorted,
    best first.
    """
    dtype = hypotheses.misfit.dtype
    low, high = jnp.asarray(box.low, dtype) - _ROOM, jnp.asarray(box.high, dtype) + _ROOM
    probes = low + (high - low) * jnp.asarray(np.random.default_rng(0).random((_NUM_PROBES, 3)), dtype)

    def distances(one):
        return one.placement.distance(bank.shape(one.shape).solid, probes)

    values = jax.lax.map(distances, hypotheses, batch_size=8)

    def off(row):
        return jnp.max(jnp.abs(values - row), axis=1)

    is_same = (jax.lax.map(off, values, batch_size=4) < SAME) & (hypotheses.shape[:, None] == hypotheses.shape)
    modes = first_of_each(is_same)
    return dataclasses.replace(hypotheses, is_mode=modes, misfit=jnp.where(modes, hypotheses.misfit, jnp.inf))
