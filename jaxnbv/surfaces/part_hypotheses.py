"""Which part the object is and how it lies: hypotheses with weights, carried from view to view."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import InputError
from jaxnbv.geometry.volume import Box
from jaxnbv.observations import Observations
from jaxnbv.scanning import Grid, GridSurface
from jaxnbv.surfaces.part_evidence import LEAST_TAU, Rays, evidence
from jaxnbv.surfaces.part_search import nothing_before, search_parts
from jaxnbv.surfaces.placement import Placement, ShapePoses
from jaxnbv.surfaces.registration import NUM_POINTS, Hypotheses, Seen
from jaxnbv.surfaces.shape_bank import ShapeBank

NONE = "none of these"
# Placements that are tried with each part.
_NUM_STARTS = 1024
# Where there is a cloud alone, its points count as so many rays; and E at which a part is as likely as none.
_NUM_RAYS, _NONE_MISFIT = 0.3 * NUM_POINTS, 0.6


class PartHypotheses(eqx.Module):
    """Parts of a bank, each with a placement, the likeliest first.

    - `bank`: at true size, in scene units.
    - `placed`: which part and where; the same part may stand in several places, and equal surfaces count once.
    - `weights`: how likely each is, and last how likely the object is none of the bank's.
    - `tau`: how far a measured point may lie from the surface, in scene units, see `part_evidence`.
    """

    bank: ShapeBank
    placed: Hypotheses
    weights: Float[Array, " h_and_none"]
    tau: Float[Array, ""]

    def surfaces(self, grid: Grid, count: int) -> GridSurface:
        """The first few placed parts as surfaces on a grid, along a leading axis."""
        return _on_grid(self, grid, count)

    @property
    def shape_weights(self) -> Float[Array, " k"]:
        """How likely each part of the bank is."""
        return jnp.zeros(len(self.bank)).at[self.placed.shape].add(self.weights[:-1])

    @property
    def part_weights(self) -> Float[Array, " k_and_none"]:
        """How likely each part of the bank is, and last how likely the object is none of them."""
        return jnp.append(self.shape_weights, self.weights[-1])

    def names(self) -> dict[str, float]:
        """How likely the object is each part, most likely first, and "none of these"; parts that no hypothesis is
        about are left out."""
        each = np.asarray(self.shape_weights, np.float64)
        listed = {name: float(weight) for name, weight in zip(self.bank.names, each, strict=True) if weight > 0}
        listed[NONE] = float(self.weights[-1])
        return dict(sorted(listed.items(), key=lambda item: -item[1]))

    @property
    def likeliest(self) -> tuple[int, Placement]:
        """Index in the bank of the likeliest part, and the likeliest of its placements."""
        shapes, weights = np.asarray(self.placed.shape), np.asarray(self.weights)[:-1]
        part = int(np.argmax(np.bincount(shapes, weights, len(self.bank))))
        row = int(np.argmax(np.where(shapes == part, weights, -1.0)))
        return part, jax.tree.map(lambda rows: rows[row], self.placed.placement)


def hypotheses_of(observations: Observations) -> PartHypotheses:
    """What the observations hold of known parts.

    **Raises:** `ValueError` if that is nothing.
    """
    if not isinstance(observations.hypotheses, PartHypotheses):
        raise InputError("there are no hypotheses: the planner knows no parts; use Planner.for_parts(bank)")
    return observations.hypotheses


def identify(
    bank: ShapeBank, poses: ShapePoses, box: Box, observations: Observations, before: PartHypotheses | None
) -> PartHypotheses:
    """The hypotheses given the observations.

    - `bank`: at true size, in scene units; `poses`: how its parts can lie; `box`: what holds the object.
    - `before`: those of the view before, which stay for as long as they fit.
    """
    seen = Seen.of(observations)
    previous = nothing_before(seen.points.dtype) if before is None else before.placed
    rays = Rays.of(observations, box)
    return _weighted(bank, search_parts(bank, poses, box, seen, rays, previous, _NUM_STARTS), rays)


@eqx.filter_jit
def _weighted(bank: ShapeBank, placed: Hypotheses, rays: Rays | None) -> PartHypotheses:
    if rays is None:
        misfit, misfit_of_none = _NUM_RAYS * placed.misfit, jnp.asarray(_NUM_RAYS * _NONE_MISFIT)
        tau = jnp.asarray(LEAST_TAU)
    else:
        misfit, misfit_of_none = evidence(bank, placed, rays)
        tau = rays.tau
    misfit = jnp.where(placed.is_mode, misfit, jnp.inf)
    weights = jax.nn.softmax(-jnp.append(misfit, misfit_of_none))
    order = jnp.argsort(misfit, stable=True)
    placed = jax.tree.map(lambda rows: rows[order], placed)
    return PartHypotheses(bank, placed, jnp.append(weights[:-1][order], weights[-1]), tau)


@eqx.filter_jit
def _on_grid(hypotheses: PartHypotheses, grid: Grid, count: int) -> GridSurface:
    first = jax.tree.map(lambda rows: rows[:count], hypotheses.placed)
    solids = hypotheses.bank.shape(first.shape).solid
    axis = jnp.asarray(grid.axis, first.misfit.dtype)
    nodes = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)

    def values(placed):
        solid, placement = placed
        return placement.distance(solid, nodes)

    distances = jax.lax.map(values, (solids, first.placement))
    return GridSurface.from_values(distances.reshape(-1, *(grid.resolution,) * 3), 0.0, grid)
