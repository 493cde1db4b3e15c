"""What a search is asked."""

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
"""The values of a batch of poses, given what it costs to go there: a function of values, observations and poses."""


class Problem(eqx.Module):
    """One step's question: where to look next.

    - `inputs`: the observations and, for a search that asks for them, the posterior samples.
    - `camera`: whose scans are imagined.
    - `acquisition`: what a view is worth.
    - `obstacles`: what stands around the object, hides it, and keeps cameras out; None for nothing.
    - `cost`: how the cost of going there counts against the value; None where it does not.
    - `pending`: poses that were proposed before and not taken; None for none.
    - `context`: what the acquisition makes of the inputs, once; see `prepared`.
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
        """What has been observed."""
        return self.inputs.observations

    def prepared(self) -> "Problem":
        """The same with the acquisition's context, as searches ask for it; nothing to prepare without samples."""
        context = None if self.inputs.surfaces is None else context_of(self.acquisition, self.inputs)
        return dataclasses.replace(self, context=context)

    def about(self, acquisition: Acquisition) -> "Problem":
        """The same step, asked about another acquisition."""
        return dataclasses.replace(self, acquisition=acquisition).prepared()

    def values(self, poses: Pose) -> Float[Array, " poses"]:
        """The acquisition at a batch of poses, estimated from all posterior samples."""
        return jnp.mean(self.scores(poses), axis=0)

    def scores(
        self, poses: Pose, samples: slice | Int[Array, " some"] = slice(None)
    ) -> Float[Array, "*scores samples poses"]:
        """The scores whose mean is the acquisition, sample by sample; given the cost of going there, if that counts.

        Those of an `AcquisitionList` come along a leading axis.
        """
        some = jax.tree.map(lambda leaf: leaf[samples], self.surfaces)
        barrier = barrier_of(self.obstacles, self.camera, poses)
        values = self.acquisition.sample_scores(self.context, some, self.camera, poses, barrier)
        return self.apply_cost(jnp.moveaxis(values, (0, 1), (-2, -1)), poses)

    def apply_cost(self, values: Float[Array, "*samples poses"], poses: Pose) -> Float[Array, "*samples poses"]:
        """Values of poses, given the cost of going there from the last pose that was taken."""
        return values if self.cost is None else self.cost(values, self.observations, poses)

    def expected_in_vain(self) -> Float[Array, ""]:
        """What the acquisition expects of the poses that were taken, on average, in its own units and without cost.
        Where these have nothing more to give, it may be wrong by so much elsewhere. Zero before there are two.

        The first view alone tells little: what it shows at a slant is steep to it, and not in vain.
        """
        taken = self.observations.poses
        uncosted = dataclasses.replace(self, cost=None)

        def add(index, total):
            pose = jax.tree.map(lambda rows: rows[index][None], taken.rows)
            return total + uncosted.values(pose)[0]

        total = jax.lax.fori_loop(0, taken.count, add, jnp.zeros((), taken.rows.position.dtype))
        return jnp.where(taken.count > 1, total / jnp.maximum(taken.count, 1), 0.0)

    @property
    def num_samples(self) -> int:
        """How many posterior samples there are."""
        return self.surfaces.values.shape[0]

    @property
    def surfaces(self) -> GridSurface:
        """The step's posterior samples along a leading axis.

        **Raises:** `ValueError` where there are none.
        """
        if self.inputs.surfaces is None:
            raise InputError("the acquisition needs posterior samples: set uses_samples = True on the search")
        return self.inputs.surfaces

    def is_excluded(self, poses: Pose) -> Bool[Array, " poses"]:
        """Whether each of a batch of poses was taken or proposed before, or a camera may not stand there."""
        excluded = self.observations.poses.holds(poses)
        if self.pending is not None:
            excluded |= self.pending.holds(poses)
        return excluded | (self.violation(poses) > 0)

    def violation(self, poses: Pose) -> Float[Array, " poses"]:
        """By how much each of a batch of cameras is too near to things, see `Obstacles.violation`."""
        if self.obstacles is None:
            return jnp.zeros(poses.position.shape[:-1], poses.position.dtype)
        return self.obstacles.violation(poses, self.observations.cloud)
