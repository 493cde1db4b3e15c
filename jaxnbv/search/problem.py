"""The problem that a search solves in one step."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.acquisition import Acquisition, context_of
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.observations import Observations
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import GridSurface, Obstacles, barrier_of

ApplyCost: TypeAlias = Callable[[Float[Array, "*samples poses"], Observations, Pose], Float[Array, "*samples poses"]]
"""Function of values, observations and poses (n,) that returns the values, given the cost of going to the poses."""


class Problem(eqx.Module):
    """The problem of one step: find the next pose.

    - `inputs`: the observations and, if the search needs them, the posterior samples.
    - `camera`: the camera whose scans are imagined.
    - `acquisition`: the expected worth of a view.
    - `obstacles`: solids around the object, which hide it and which cameras keep clear of; None if there are none.
    - `cost`: applies the cost of going to a pose to its value; None to ignore the cost.
    - `pending`: poses that were proposed before but not taken; None for none.
    - `context`: the acquisition's context, computed once from the inputs; see `prepared`.
    """

    inputs: StepInputs
    camera: Camera
    acquisition: Acquisition
    obstacles: Obstacles | None = None
    cost: ApplyCost | None = None
    pending: PoseList | None = None
    context: Any = None

    @property
    def observations(self) -> Observations:
        """The observations so far."""
        return self.inputs.observations

    def prepared(self) -> "Problem":
        """A copy with the acquisition's context, which searches need; without samples there is no context."""
        context = None if self.inputs.surfaces is None else context_of(self.acquisition, self.inputs)
        return dataclasses.replace(self, context=context)

    def with_acquisition(self, acquisition: Acquisition) -> "Problem":
        """A copy with another acquisition."""
        return dataclasses.replace(self, acquisition=acquisition).prepared()

    def values(self, poses: Pose) -> Float[Array, " poses"]:
        """Value of each pose: the mean of its scores over all posterior samples."""
        return jnp.mean(self.scores(poses), axis=0)

    def scores(
        self, poses: Pose, samples: slice | Int[Array, " some"] = slice(None)
    ) -> Float[Array, "*scores samples poses"]:
        """The acquisition's score for each sample and pose, with the cost of going there if it counts.

        For an `AcquisitionList`, there is a leading axis of acquisitions.
        """
        surfaces = jax.tree.map(lambda leaf: leaf[samples], self.surfaces)
        barrier = barrier_of(self.obstacles, self.camera, poses)
        values = self.acquisition.sample_scores(self.context, surfaces, self.camera, poses, barrier)
        return self.apply_cost(jnp.moveaxis(values, (0, 1), (-2, -1)), poses)

    def apply_cost(self, values: Float[Array, "*samples poses"], poses: Pose) -> Float[Array, "*samples poses"]:
        """Values of poses, given the cost of going there from the last view."""
        return values if self.cost is None else self.cost(values, self.observations, poses)

    def value_at_visited(self) -> Float[Array, ""]:
        """Mean value that the acquisition expects at the visited poses, in its own units and without cost.

        If a second view from a pose gains nothing, this value is an error, and may be so at other poses. Zero before
        there are two views: after one view the surface that it saw at a slant still counts, and not in vain.
        """
        visited = self.observations.poses
        uncosted = dataclasses.replace(self, cost=None)

        def add(index, total):
            pose = jax.tree.map(lambda rows: rows[index][None], visited.rows)
            return total + uncosted.values(pose)[0]

        total = jax.lax.fori_loop(0, visited.count, add, jnp.zeros((), visited.rows.position.dtype))
        return jnp.where(visited.count > 1, total / jnp.maximum(visited.count, 1), 0.0)

    @property
    def num_samples(self) -> int:
        """Number of posterior samples."""
        return self.surfaces.values.shape[0]

    @property
    def surfaces(self) -> GridSurface:
        """The step's posterior samples, along a leading axis.

        **Raises:** `ValueError` if there are none.
        """
        if self.inputs.surfaces is None:
            raise InputError("the acquisition needs posterior samples: set uses_samples = True on the search")
        return self.inputs.surfaces

    def is_excluded(self, poses: Pose) -> Bool[Array, " poses"]:
        """Mask of the poses that were visited or proposed before, or violate the clearance."""
        excluded = self.observations.poses.contains(poses)
        if self.pending is not None:
            excluded |= self.pending.contains(poses)
        return excluded | (self.violation(poses) > 0)

    def violation(self, poses: Pose) -> Float[Array, " poses"]:
        """How far each camera violates the clearance, in scene units, see `Obstacles.violation`."""
        if self.obstacles is None:
            return jnp.zeros(poses.position.shape[:-1], poses.position.dtype)
        return self.obstacles.violation(poses, self.observations.cloud)
