"""The problem that a search solves to choose one view."""

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
"""Function that combines values of poses with the cost of the move from the last view to each pose.

Its arguments are the values, the observations and the poses. It returns the new values.
"""


# Largest number of visited poses that are scored together with the candidates.
_NUM_LATEST = 8


class Problem(eqx.Module):
    """The problem of finding the next pose.

    - `inputs`: the observations and, if the search uses samples, the posterior and its samples.
    - `camera`: the camera whose scans are simulated.
    - `cost`: function that combines values with the cost of the move; None to ignore the cost.
    - `pending`: earlier proposals, which are not proposed again even if the view was taken elsewhere.
    - `context`: context of the acquisition, which `prepared` computes once from the inputs.
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
        return self.inputs.observations

    def prepared(self) -> "Problem":
        """Return a copy with the acquisition's context, which `scores` needs. Without samples it is None."""
        context = None if self.inputs.surfaces is None else context_of(self.acquisition, self.inputs)
        return dataclasses.replace(self, context=context)

    def with_acquisition(self, acquisition: Acquisition) -> "Problem":
        """Return a copy with a different acquisition and its context."""
        return dataclasses.replace(self, acquisition=acquisition).prepared()

    def values(self, poses: Pose) -> Float[Array, " poses"]:
        """Return the value of each pose: the mean of its scores over all posterior samples."""
        return jnp.mean(self.scores(poses), axis=0)

    def scores(
        self, poses: Pose, samples: slice | Int[Array, " rows"] = slice(None)
    ) -> Float[Array, "*scores samples poses"]:
        """Return the score of each pose on each sample, after the cost is applied.

        An `AcquisitionList` adds a leading axis.

        - `samples`: indices of the samples to score on, by default all.
        """
        surfaces = jax.tree.map(lambda leaf: leaf[samples], self.surfaces)
        barrier = barrier_of(self.obstacles, self.camera, poses)
        values = self.acquisition.sample_scores(self.context, surfaces, self.camera, poses, barrier)
        return self.apply_cost(jnp.moveaxis(values, (0, 1), (-2, -1)), poses)

    def apply_cost(self, values: Float[Array, "*samples poses"], poses: Pose) -> Float[Array, "*samples poses"]:
        """Return the values after `cost` is applied, or the values themselves without a cost."""
        return values if self.cost is None else self.cost(values, self.observations, poses)

    @property
    def distance_breaks_ties(self) -> bool:
        """Whether `DiscreteSearch` proposes the tied candidate that is farthest from the earlier cameras.

        It does if a second view from the same pose gains nothing (`Acquisition.gains_once`), unless moves have a cost,
        because a cost favours near candidates.
        """
        return self.acquisition.gains_once and self.cost is None

    @property
    def latest_poses(self) -> Pose:
        """The poses of the latest views, eight at most, latest first.

        With fewer views, the pose of the first view fills the remaining rows.
        """
        poses = self.observations.poses
        index = poses.count - 1 - jnp.arange(min(_NUM_LATEST, poses.capacity))
        return poses.rows[jnp.maximum(index, 0)]

    def value_at_visited(self, scores: Float[Array, "samples rows"]) -> Float[Array, ""]:
        """Return the mean value that the acquisition expects at the latest poses.

        If a second view from the same pose gains nothing, the true value is zero. The result then shows how large
        errors may be at other poses. After a single view the result is 0, because the value at its pose is no error: it
        comes from surface that the view saw only at a steep angle.

        - `scores`: scores of `latest_poses`.
        """
        count, rows = self.observations.poses.count, scores.shape[1]
        values = jnp.where(jnp.arange(rows) < count, jnp.mean(scores, axis=0), 0.0)
        return jnp.where(count > 1, jnp.sum(values) / jnp.clip(count, 1, rows), 0.0)

    @property
    def num_samples(self) -> int:
        """Number of posterior samples."""
        return self.surfaces.values.shape[0]

    @property
    def surfaces(self) -> GridSurface:
        """The posterior samples, along a leading axis.

        **Raises:** `ValueError` if the inputs have no samples.
        """
        if self.inputs.surfaces is None:
            raise InputError("the acquisition needs posterior samples: set uses_samples = True on the search")
        return self.inputs.surfaces

    def is_excluded(self, poses: Pose) -> Bool[Array, " poses"]:
        """Return whether each pose was visited or proposed before, or is too close to obstacles or the cloud."""
        is_excluded = self.observations.poses.contains(poses)
        if self.pending is not None:
            is_excluded |= self.pending.contains(poses)
        return is_excluded | (self.violation(poses) > 0)

    def violation(self, poses: Pose) -> Float[Array, " poses"]:
        """Return the length by which each pose is too close to obstacles or the cloud, see `Obstacles`."""
        if self.obstacles is None:
            return jnp.zeros(poses.position.shape[:-1], poses.position.dtype)
        return self.obstacles.violation(poses, self.observations.cloud)
