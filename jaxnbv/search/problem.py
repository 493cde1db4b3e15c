"""What a search is asked."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.acquisition import Acquisition, context_of, sample_scores
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.scanning import GridSurface, Obstacles

Weighing: TypeAlias = Callable[[Float[Array, "*samples poses"], Observations, Pose], Float[Array, "*samples poses"]]
"""The values of a batch of poses, given what it costs to go there: a function of values, observations and poses."""


class Problem(eqx.Module):
    """One step's question: where to look next.

    - `observations`: what has been seen, and from where.
    - `camera`: whose scans are imagined.
    - `acquisition`: what is sought.
    - `surfaces`: the step's posterior samples along a leading axis; None for a search that does not ask for them.
    - `obstacles`: what stands around the object, hides it, and keeps cameras out; None for nothing.
    - `cost`: how the cost of going there counts against the value; None where it does not.
    - `context`: what the acquisition makes of D, once; see `prepared`.
    """

    observations: Observations
    camera: Camera
    acquisition: Acquisition
    surfaces: GridSurface | None
    obstacles: Obstacles | None = None
    cost: Weighing | None = None
    context: Any = None

    def prepared(self) -> "Problem":
        """The same with the acquisition's context, as searches ask for it; nothing to prepare without samples."""
        context = None if self.surfaces is None else context_of(self.acquisition, self.observations)
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

        Those of a `AcquisitionList` come along a leading axis.
        """
        some = jax.tree.map(lambda leaf: leaf[samples], self._sampled)
        barrier = None if self.obstacles is None else self.obstacles.barrier(self.camera, poses)
        values = sample_scores(self.acquisition, self.context, some, self.camera, poses, barrier)
        return self.apply_cost(jnp.moveaxis(values, (0, 1), (-2, -1)), poses)

    def apply_cost(self, values: Float[Array, "*samples poses"], poses: Pose) -> Float[Array, "*samples poses"]:
        """Values of poses, given the cost of going there from the last view."""
        if self.cost is None:
            return values
        return self.cost(values, self.observations, poses)

    @property
    def num_samples(self) -> int:
        """How many posterior samples there are."""
        return self._sampled.values.shape[0]

    @property
    def _sampled(self) -> GridSurface:
        if self.surfaces is None:
            raise InputError("the acquisition needs posterior samples: set uses_samples = True on the search")
        return self.surfaces

    def is_excluded(self, poses: Pose) -> Bool[Array, " poses"]:
        """Whether each of a batch of poses was taken before, or a camera may not stand there."""
        visited = self.is_visited(poses)
        return (
            visited if self.obstacles is None else visited | self.obstacles.is_excluded(poses, self.observations.cloud)
        )

    def violation(self, poses: Pose) -> Float[Array, " poses"]:
        """By how much each of a batch of cameras is too near to things, see `Obstacles.violation`."""
        if self.obstacles is None:
            return jnp.zeros(poses.position.shape[:-1], poses.position.dtype)
        return self.obstacles.violation(poses, self.observations.cloud)

    def is_visited(self, poses: Pose) -> Bool[Array, " poses"]:
        """Whether each of a batch of poses equals one taken before, to 1e-3 in position and viewing direction."""
        near = jnp.linalg.norm(poses.position[:, None] - self.observations.poses.position[None], axis=-1) < 1e-3
        aligned = jnp.linalg.norm(poses.forward[:, None] - self.observations.poses.forward[None], axis=-1) < 1e-3
        return jnp.any(near & aligned & self._is_filled, axis=1)

    def distance_to_visited(self, poses: Pose) -> Float[Array, " poses"]:
        """Distance from each of a batch of positions to the nearest one taken before; infinite if there is none."""
        distance = jnp.linalg.norm(poses.position[:, None] - self.observations.poses.position[None], axis=-1)
        return jnp.min(jnp.where(self._is_filled, distance, jnp.inf), axis=1)

    @property
    def _is_filled(self) -> Bool[Array, " views"]:
        return jnp.arange(self.observations.poses.position.shape[0]) < self.observations.num_views
