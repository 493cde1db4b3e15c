"""A triangle mesh as a solid that can be traced within JAX: its signed distance, sampled on a grid."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.checks import AnyArray, as_numbers, checked, require
from jaxnbv.scanning.sdf.base import Scalar, SignedDistance, Vector, nonnegative, norm, parameter, split

# Of the longest side, on all sides.
_PADDING = 0.1


class Sampled(SignedDistance):
    """A solid by its signed distances at the nodes of a grid, trilinear between them. Right to about a cell within the
    grid, a bound beyond it.

    - `values`: at the nodes; `low`: the first of them; `spacing`: between them.
    - `padding`: by how much the grid is larger than the solid on all sides.
    """

    values: Float[Array, "a b c"] = parameter()
    low: Vector = parameter()
    spacing: Scalar = nonnegative()
    padding: Scalar = nonnegative()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        high = self.low + self.spacing * (jnp.array(self.values.shape) - 1)
        nearest = jnp.clip(x, self.low, high)
        places = jnp.moveaxis((nearest - self.low) / self.spacing, -1, 0)
        found = jax.scipy.ndimage.map_coordinates(self.values, list(places), order=1, mode="nearest")
        beyond = norm(*split(x - nearest))
        return jnp.where(beyond > 0, beyond + self.padding, found)


@checked
def solid_of_mesh(vertices: Float[AnyArray, "v 3"], faces: Int[AnyArray, "f 3"], resolution: int = 64) -> Sampled:
    """A mesh as a solid, in the coordinates of its vertices: an obstacle, say. Its inside is told by winding numbers,
    so that it may have holes.

    - `resolution`: nodes along its longest side.

    **Raises:** `ValueError` for other shapes, indices out of range, or a resolution below four.
    """
    vertices = as_numbers(vertices, "the mesh's vertices", np.float64)
    faces = as_numbers(faces, "the mesh's faces", np.int64)
    for name, array in (("vertices", vertices), ("faces", faces)):
        require(
            array.ndim == 2 and array.shape[1] == 3 and len(array) > 0,
            f"the mesh's {name} must be (n, 3), got {array.shape}",
        )
    require(
        faces.min() >= 0 and faces.max() < len(vertices),
        f"faces refer to vertices {faces.min()} to {faces.max()}, but there are {len(vertices)}",
    )
    require(bool(np.isfinite(vertices).all()), "the mesh has vertices that are not finite")
    require(resolution >= 4, f"the resolution is {resolution}; it must be at least 4")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    longest = float((high - low).max())
    require(longest > 0, f"all {len(vertices)} vertices of the mesh lie at {low}")
    spacing = (1.0 + 2.0 * _PADDING) * longest / (resolution - 1)
    low = low - _PADDING * longest
    counts = np.ceil((high + _PADDING * longest - low) / spacing).astype(int) + 1
    axes = [start + spacing * np.arange(count) for start, count in zip(low, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    distance, *_ = igl.signed_distance(nodes.reshape(-1, 3), vertices, faces, kind)
    return Sampled(distance.reshape(counts), low, spacing, _PADDING * longest)
