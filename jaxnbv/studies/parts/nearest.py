"""An oracle in place of a network that segments: it separates what planning does from what the network does."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float, Int

from jaxnbv.geometry.cloud import PointCloud, farthest_point_subsample
from jaxnbv.scanning import Grid, MeshParts

# Twice the standard deviation of the sensor's noise.
_WIDTH = 0.02
# Of a part that is not there: its probability is zero, and so is every derivative.
_NOWHERE = 100.0


class NearestPart(eqx.Module):
    """The parts of an object that is known: p_ic in proportion to exp(-d_ic^2 / 2 w^2), w = 0.02 scene units, with the
    distance d_ic of point i from the true part c.

    Objects that differ share one compilation if they have room for as many parts.

    - `distances`: of each part, at the nodes of `grid`; between them linear.
    - `num_points`: what is told apart, by farthest point sampling.
    """

    distances: Float[Array, "parts g g g"]
    grid: Grid
    num_points: int = eqx.field(static=True)

    @classmethod
    def of(cls, parts: MeshParts, room: int, grid: Grid, num_points: int) -> "NearestPart":
        """Of a mesh, with room for so many parts."""
        distances = parts.distances(grid)
        absent = ((0, room - len(distances)), (0, 0), (0, 0), (0, 0))
        return cls(jnp.pad(distances, absent, constant_values=_NOWHERE), grid, num_points)

    def __call__(self, cloud: PointCloud) -> Float[Array, "num_points parts"]:
        """p, and zeros in rows without a point."""
        fed = farthest_point_subsample(cloud, self.num_points)
        p = jax.nn.softmax(-0.5 * (self.distances_at(fed.points) / _WIDTH) ** 2, axis=-1)
        return jnp.where(fed.mask[:, None], p, 0.0)

    def predict(self, cloud: PointCloud) -> tuple[PointCloud, Int[Array, " num_points"]]:
        """The points that are told apart, and the nearest part of each; -1 in rows without a point."""
        fed = farthest_point_subsample(cloud, self.num_points)
        return fed, jnp.where(fed.mask, self.nearest(fed.points), -1)

    def nearest(self, points: Float[Array, "n 3"]) -> Int[Array, " n"]:
        """The part nearest to each point."""
        return jnp.argmin(self.distances_at(points), axis=-1).astype(jnp.int32)

    def distances_at(self, points: Float[Array, "n 3"]) -> Float[Array, "n parts"]:
        """Beyond the grid those at its border."""
        at = (points.T + self.grid.half_extent) / self.grid.spacing
        of_part = jax.vmap(lambda values: map_coordinates(values, list(at), order=1, mode="nearest"), out_axes=-1)
        return of_part(self.distances)
