"""Unions of labelled primitives. All unions have arrays of the same shapes, so they share compiled programs."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.scanning.sdf.base import SignedDistance, corner_distance, least_of_last, nonnegative, parameter

# Label of an unused slot. All unions have the same number of slots, and each primitive takes one slot.
UNUSED = -1


class LabelledSolid(SignedDistance):
    """The union of labelled rounded boxes and solids of revolution. The distance is a lower bound.

    A point x has the coordinates u = rotation^T (x - centre) in the frame of a primitive. With h = half_size and
    t = rounding, the distance to the box [-h, h] rounded by t is

        d(u) = |max(q, 0)| + min(max(q1, q2, q3), 0) - t,    q = |u| - (h - t).

    A solid of revolution about the axis u2 uses the two-dimensional form of d at the point (r - radius - slant * u2,
    u2), where r is the distance from the axis. The result is divided by (|slant| + sqrt(slant^2 + 4)) / 2, the largest
    singular value of the shear by `slant`.

    - `labels`, `revolved`: label of each primitive (-1 for an unused slot), and whether it is a solid of revolution.
    - `centre`, `rotation`, `half_size`, `rounding`: the quantities of the formula, in scene units. For a solid of
      revolution, the half sizes are the half width, half height and again half height of the profile.
    - `radius`, `slant`: for a solid of revolution, the ring's radius (0 for a full solid) and its growth with height.
    """

    labels: Int[Array, " slots"]
    revolved: Bool[Array, " slots"]
    centre: Float[Array, "slots 3"] = parameter()
    rotation: Float[Array, "slots 3 3"] = parameter()
    half_size: Float[Array, "slots 3"] = nonnegative()
    rounding: Float[Array, " slots"] = nonnegative()
    radius: Float[Array, " slots"] = nonnegative()
    slant: Float[Array, " slots"] = parameter()

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return least_of_last(self.distances(x))

    def distances(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n primitives"]:
        """Return the signed distance from the points x to each primitive; infinite for unused slots."""
        a, b, c = (x[..., i, None] - self.centre[:, i] for i in range(3))
        # This is R^T x. XLA fuses the sums with other operations, but would not fuse a matrix product.
        u, v, w = (
            a * self.rotation[:, 0, i] + b * self.rotation[:, 1, i] + c * self.rotation[:, 2, i] for i in range(3)
        )
        u = jnp.where(self.revolved, safe_norm(u, w) - self.radius - self.slant * v, u)
        w = jnp.where(self.revolved, 0.0, w)
        half = self.half_size - self.rounding[:, None]
        distance = (
            corner_distance(jnp.abs(u) - half[:, 0], jnp.abs(v) - half[:, 1], jnp.abs(w) - half[:, 2]) - self.rounding
        )
        stretch = 0.5 * (jnp.abs(self.slant) + jnp.sqrt(self.slant**2 + 4.0))
        return jnp.where(self.labels > UNUSED, distance / stretch, jnp.inf)

    def part_labels(self, x: Float[AnyArray, "*n 3"]) -> Int[Array, "*n"]:
        """Return the label of the primitive whose surface is nearest to each point x.

        Distances to primitives are lower bounds, so the label is reliable only for points on the surface of the union.
        """
        return self.labels[jnp.argmin(jnp.abs(self.distances(x)), axis=-1)]
