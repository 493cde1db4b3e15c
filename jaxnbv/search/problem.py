"""What a search is asked."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.acquisition import Score, sample_scores
from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud, concatenate
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.travel import Cost
from jaxnbv.scanning import GridSurface
from jaxnbv.scanning.surroundings import Surroundings


class Problem(eqx.Module):
    """One step's question: where to look next.

    - `cloud`: D, what has been seen.
    - `visited`: the poses taken so far in the first `num_visited` rows; the others hold nothing.
    - `surfaces`: the step's posterior samples along a leading axis; None for a search that does not ask for them.
    - `cost`: how the cost of going there counts against the value; None where it does not.
    - `surroundings`: what stands around the object, and hides it; `empty`: the nodes of the grid that were seen empty,
      and `half_extent` of that grid; None where they are not known.
    - `imagined`: what earlier views of a batch would show of each sample, along the same axis; None for a single view.
    - `context`: what the score makes of D, once, or of D and what is imagined, once a sample; None without samples.
    """

    cloud: PointCloud
    visited: Pose
    num_visited: Int[Array, ""]
    camera: Camera
    score: Score
    surfaces: GridSurface | None
    cost: Cost | None
    surroundings: Surroundings | None
    empty: Bool[Array, "g g g"] | None
    half_extent: float | None = eqx.field(static=True)
    imagined: PointCloud | None
    context: Any

    def __init__(
        self,
        cloud: PointCloud,
        visited: Pose,
        num_visited: Int[Array, ""],
        camera: Camera,
        score: Score,
        surfaces: GridSurface | None,
        cost: Cost | None = None,
        imagined: PointCloud | None = None,
        surroundings: Surroundings | None = None,
        empty: Bool[Array, "g g g"] | None = None,
        half_extent: float | None = None,
    ):
        self.cloud, self.visited, self.num_visited = cloud, visited, num_visited
        self.camera, self.score, self.surfaces = camera, score, surfaces
        self.cost, self.imagined, self.context = cost, imagined, None
        self.surroundings, self.empty, self.half_extent = surroundings, empty, half_extent
        if imagined is not None:
            self.context = jax.lax.map(lambda scan: score.context(concatenate(cloud, scan)), imagined)
        elif surfaces is not None:
            self.context = score.context(cloud)

    def acquisition(self, poses: Pose, samples: slice = slice(None)) -> Float[Array, " poses"]:
        """The acquisition at a batch of poses, estimated from all posterior samples or from a part of them."""
        return jnp.mean(self.scores(poses, samples), axis=0)

    def about(self, score: Score) -> "Problem":
        """The same step, asked about another score."""
        known, scene = (self.cloud, self.visited, self.num_visited), (self.surroundings, self.empty, self.half_extent)
        return Problem(*known, self.camera, score, self.surfaces, self.cost, self.imagined, *scene)

    def scores(self, poses: Pose, samples: slice = slice(None)) -> Float[Array, "*scores samples poses"]:
        """The scores whose mean is the acquisition, sample by sample; given the cost of going there, if that counts.

        Those of a `Several` come along a leading axis.
        """

        def part(tree):
            return jax.tree.map(lambda leaf: leaf[samples], tree)

        own = self.imagined is not None
        context = part(self.context) if own else self.context
        barrier = None if self.surroundings is None else self.surroundings.barrier(self.camera, poses)
        values = sample_scores(self.score, context, part(self._sampled), self.camera, poses, own, barrier)
        return self.worth(jnp.moveaxis(values, (0, 1), (-2, -1)), poses)

    def worth(self, values: Float[Array, "*samples poses"], poses: Pose) -> Float[Array, "*samples poses"]:
        """Values of poses, given the cost of going there from the last view."""
        if self.cost is None:
            return values
        here, of = jax.tree.map(lambda rows: rows[self.num_visited - 1], self.visited), self.cost.of
        cost = jax.vmap(lambda pose: of(here, pose))(poses)
        return self.cost(values, jnp.where(self.num_visited > 0, cost, 0.0))

    @property
    def num_samples(self) -> int:
        """How many posterior samples there are."""
        return self._sampled.values.shape[0]

    @property
    def _sampled(self) -> GridSurface:
        if self.surfaces is None:
            raise InputError("the acquisition needs posterior samples: set uses_samples = True on the search")
        return self.surfaces

    def is_closed(self, poses: Pose) -> Bool[Array, " poses"]:
        """Whether each of a batch of poses was taken before, or a camera may not stand there."""
        visited = self.is_visited(poses)
        if self.surroundings is None:
            return visited
        return visited | self.surroundings.is_closed(poses, self.cloud, self.empty, self.half_extent)

    def trespass(self, poses: Pose) -> Float[Array, " poses"]:
        """By how much each of a batch of cameras is too near to things, see `Surroundings.trespass`."""
        if self.surroundings is None:
            return jnp.zeros(poses.position.shape[:-1], poses.position.dtype)
        return self.surroundings.trespass(poses, self.cloud)

    def is_visited(self, poses: Pose) -> Bool[Array, " poses"]:
        """Whether each of a batch of poses equals one taken before, to 1e-3 in position and viewing direction."""
        near = jnp.linalg.norm(poses.position[:, None] - self.visited.position[None], axis=-1) < 1e-3
        aligned = jnp.linalg.norm(poses.forward[:, None] - self.visited.forward[None], axis=-1) < 1e-3
        return jnp.any(near & aligned & self._is_filled, axis=1)

    def distance_to_visited(self, poses: Pose) -> Float[Array, " poses"]:
        """Distance from each of a batch of positions to the nearest one taken before; infinite if there is none."""
        distance = jnp.linalg.norm(poses.position[:, None] - self.visited.position[None], axis=-1)
        return jnp.min(jnp.where(self._is_filled, distance, jnp.inf), axis=1)

    @property
    def _is_filled(self) -> Bool[Array, " views"]:
        return jnp.arange(self.visited.position.shape[0]) < self.num_visited
