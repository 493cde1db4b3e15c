"""Weighted hypotheses, carried from view to view: which known part the object is, and where it is."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import InputError
from jaxnbv.geometry.volume import Box
from jaxnbv.observations import Observations
from jaxnbv.programs import program
from jaxnbv.scanning import Grid, GridSurface
from jaxnbv.surfaces.part_evidence import MIN_TAU, Rays, evidence
from jaxnbv.surfaces.part_search import placeholder_hypotheses, search_parts
from jaxnbv.surfaces.placement import Placement, ShapePoses
from jaxnbv.surfaces.registration import NUM_POINTS, FitTargets, Hypotheses
from jaxnbv.surfaces.shape_bank import ShapeBank

NONE = "none of these"
# Number of placements tried for each part.
_NUM_STARTS = 1024
# For a cloud without rays: the number of rays that its points count as, and the misfit of "none of these".
_NUM_RAYS, _NONE_MISFIT = 0.3 * NUM_POINTS, 0.6


class PartHypotheses(eqx.Module):
    """Parts of a bank, each with a placement, the most likely first.

    - `bank`: the parts at true size, in scene units.
    - `placed`: part, placement and misfit of each hypothesis. If several placements give a part the same surface, only
      one of them has a finite misfit, and a weight above zero.
    - `weights`: probability of each hypothesis, followed by the probability of "none of these".
    - `tau`: scale of the distances from measured points to the surface, in scene units, see `part_evidence`.
    - `misfit_of_none`: misfit of "none of these", comparable with the misfits of `placed`.
    """

    bank: ShapeBank
    placed: Hypotheses
    weights: Float[Array, " h_and_none"]
    tau: Float[Array, ""]
    misfit_of_none: Float[Array, ""]

    def surfaces(self, grid: Grid, count: int) -> GridSurface:
        """Return the first `count` placed parts as surfaces on a grid, along a leading axis."""
        return _evaluate_on_grid(self, grid, count)

    @property
    def shape_weights(self) -> Float[Array, " k"]:
        """Probability of each part of the bank."""
        return jnp.zeros(len(self.bank)).at[self.placed.shape].add(self.weights[:-1])

    @property
    def part_weights(self) -> Float[Array, " k_and_none"]:
        """Probability of each part of the bank, followed by the probability of "none of these"."""
        return jnp.append(self.shape_weights, self.weights[-1])

    def names(self) -> dict[str, float]:
        """Return the probability of "none of these" and the nonzero probabilities of parts, largest first."""
        weights = np.asarray(self.shape_weights, np.float64)
        probability = {name: float(weight) for name, weight in zip(self.bank.names, weights, strict=True) if weight > 0}
        probability[NONE] = float(self.weights[-1])
        return dict(sorted(probability.items(), key=lambda item: -item[1]))

    @property
    def most_likely(self) -> tuple[int, Placement]:
        """The index of the most likely part in the bank, and the most likely placement of this part."""
        shapes, weights = np.asarray(self.placed.shape), np.asarray(self.weights)[:-1]
        part = int(np.argmax(np.bincount(shapes, weights, len(self.bank))))
        row = int(np.argmax(np.where(shapes == part, weights, -1.0)))
        return part, jax.tree.map(lambda rows: rows[row], self.placed.placement)


def hypotheses_of(observations: Observations) -> PartHypotheses:
    """Return the hypotheses about known parts that the observations carry.

    **Raises:** `ValueError` if the observations have no hypotheses.
    """
    if not isinstance(observations.hypotheses, PartHypotheses):
        raise InputError("there are no hypotheses: the planner knows no parts; use Planner.for_parts(bank)")
    return observations.hypotheses


def identify(
    bank: ShapeBank, poses: ShapePoses, box: Box, observations: Observations, previous: PartHypotheses | None
) -> PartHypotheses:
    """Return the weighted hypotheses given the observations.

    - `bank`: the parts at true size, in scene units.
    - `poses`, `box`: the possible placements, and a box around the object.
    - `previous`: the hypotheses after the previous view, or None at the first view. They are kept while they fit.
    """
    targets = FitTargets.of(observations)
    starts = placeholder_hypotheses(targets.points.dtype) if previous is None else previous.placed
    rays = Rays.of(observations, box)
    return _weigh(bank, search_parts(bank, poses, box, targets, rays, starts, _NUM_STARTS), rays)


@program
def _weigh(bank: ShapeBank, hypotheses: Hypotheses, rays: Rays | None) -> PartHypotheses:
    if rays is None:
        misfit, misfit_of_none = _NUM_RAYS * hypotheses.misfit, jnp.asarray(_NUM_RAYS * _NONE_MISFIT)
        tau = jnp.asarray(MIN_TAU)
    else:
        misfit, misfit_of_none = evidence(bank, hypotheses, rays)
        tau = rays.tau
    misfit = jnp.where(hypotheses.is_distinct, misfit, jnp.inf)
    weights = jax.nn.softmax(-jnp.append(misfit, misfit_of_none))
    order = jnp.argsort(misfit, stable=True)
    placed = jax.tree.map(lambda rows: rows[order], dataclasses.replace(hypotheses, misfit=misfit))
    return PartHypotheses(bank, placed, jnp.append(weights[:-1][order], weights[-1]), tau, misfit_of_none)


@program
def _evaluate_on_grid(hypotheses: PartHypotheses, grid: Grid, count: int) -> GridSurface:
    first = jax.tree.map(lambda rows: rows[:count], hypotheses.placed)
    solids = hypotheses.bank.shape(first.shape).solid
    axis = jnp.asarray(grid.axis, first.misfit.dtype)
    nodes = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)

    def values(part):
        solid, placement = part
        return placement.distance(solid, nodes)

    distances = jax.lax.map(values, (solids, first.placement))
    return GridSurface.from_values(distances.reshape(-1, *(grid.resolution,) * 3), 0.0, grid)
