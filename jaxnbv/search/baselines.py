"""The paper's three baselines, which have the same default candidates as the discrete search."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.geometry.pose import Pose
from jaxnbv.search.base import Baseline
from jaxnbv.search.problem import Problem
from jaxnbv.utility import Quantity


class FarthestView(Baseline):
    """Baseline that proposes the candidate farthest from its nearest earlier camera."""

    def quantity(self, acquisition: Acquisition) -> Quantity:
        meaning = "distance from a candidate to the nearest camera so far, whatever the surface."
        return Quantity("distance to the nearest camera", "", meaning, length_power=1)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        return problem.observations.poses.distance(candidates)


class RandomView(Baseline):
    """Baseline that proposes a candidate uniformly at random among those that are not excluded."""

    def quantity(self, acquisition: Acquisition) -> Quantity:
        meaning = "a random number for each candidate that is left, whatever the surface."
        return Quantity("lot drawn", "uniform on [0, 1)", meaning, smooth=False)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        return jax.random.uniform(key, (self.candidates.count,))


class UncertaintyView(Baseline):
    """Baseline that proposes the candidate of the largest `uncertain_length` (Holalkere et al. 2025)."""

    uses_samples: ClassVar[bool] = True
    uses_cost: ClassVar[bool] = True

    def quantity(self, acquisition: Acquisition) -> Quantity:
        meaning = "length of the principal ray along which the posterior samples disagree whether it has hit."
        return Quantity("uncertain length of the principal ray", "", meaning, length_power=1)

    def values(self, problem: Problem, candidates: Pose, key: PRNGKeyArray) -> Float[Array, " candidates"]:
        return problem.apply_cost(uncertain_length(problem, candidates), candidates)


def uncertain_length(problem: Problem, poses: Pose) -> Float[Array, " poses"]:
    """Return, for each pose, the distance between the first and the last likely hit of its principal ray.

    The principal ray starts at the camera and follows the optical axis. The transmittance T(t) is the fraction of
    sampled surfaces that the ray has not entered before distance t. It is evaluated every half cell within the samples'
    grid. The result is the distance from the first t with T(t) < 1 to the last t with T(t) > 0.05, in scene units. It
    is zero for a ray that hits no sampled surface or misses the grid.
    """
    surfaces = problem.surfaces
    grid = surfaces.grid
    step = 0.5 * grid.spacing
    # For a camera inside the grid, or outside and looking at the grid, these depths cross the whole grid.
    entry_depth = jnp.linalg.norm(poses.position, axis=-1, keepdims=True) - 3**0.5 * grid.half_extent
    depth = jnp.maximum(entry_depth, 0.0) + step * jnp.arange(int(2 * 3**0.5 * grid.half_extent / step) + 2)
    points = poses.position[:, None] + depth[..., None] * poses.forward[:, None]
    inside_grid = jnp.all(jnp.abs(points) <= grid.half_extent, axis=-1)
    coordinates = jnp.moveaxis((points + grid.half_extent) / grid.spacing, -1, 0)

    def is_open(values):
        field = jax.scipy.ndimage.map_coordinates(values, list(coordinates), order=1, mode="nearest")
        return jax.lax.cumprod(jnp.where(inside_grid, field > 0, True).astype(points.dtype), axis=1)

    transmittance = jnp.mean(jax.lax.map(is_open, surfaces.values), axis=0)
    first = jnp.min(jnp.where(inside_grid & (transmittance < 1.0), depth, jnp.inf), axis=1)
    last = jnp.max(jnp.where(inside_grid & (transmittance > 0.05), depth, -jnp.inf), axis=1)
    return jnp.maximum(last - first, 0.0)
