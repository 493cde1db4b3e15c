"""Unions of labelled primitives. All have one type, so that one compiled program scans any of them."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.scanning.sdf.base import SignedDistance, corner_distance, least_of_last, nonnegative, parameter

# Label of a slot without a primitive.
UNUSED = -1


class LabelledSolid(SignedDistance):
    """The union of labelled primitives. A bound.

    A point x has the coordinates u = rotation^T (x - centre) in a primitive's own frame. With h = half_size and
    t = rounding, its distance is that of the box [-h, h] rounded by t,

        d(u) = |max(q, 0)| + min(max(q1, q2, q3), 0) - t,    q = |u| - (h - t).

    A revolved primitive has the same distance in two dimensions, of (r - radius - slant * u2, u2) with r the distance
    from the axis u2. It is divided by the largest singular value (|slant| + sqrt(slant^2 + 4)) / 2 of this shear.

    - `labels`: label of each primitive; -1 for a slot that is not used.
    - `revolved`: whether each primitive is revolved.
    - `centre`, `rotation`, `half_size`, `rounding`: as above, in scene units. For a revolved primitive, the half width
      is the first half size, and the half height is the second and also the third.
    - `radius`, `slant`: for a revolved primitive, the radius of the ring (0 for a solid) and its growth with height.
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
        """Signed distance to each primitive; infinite for slots that are not used."""
        a, b, c = (x[..., i, None] - self.centre[:, i] for i in range(3))
        # R^T x as sums, which XLA fuses with other operations; a matrix product would not fuse.
        u, v, w = (
            a * self.rotation[:, 0, i] + b * self.rotation[:, 1, i] + c * self.rotation[:, 2, i] for i in range(3)
        )
        u = jnp.where(self.revolved, safe_norm(u, w) - self.radius - self.slant * v, u)
        w = jnp.where(self.revolved, 0.0, w)
        half = self.half_size - self.rounding[:, None]
        distance = (
            corner_distance(jnp.abs(u) - half[:, 0], jnp.abs(v) - half[:, 1], jnp.abs(w) - half[:, 2]) - self.rounding
        )
        steepest = 0.5 * (jnp.abs(self.slant) + jnp.sqrt(self.slant**2 + 4.0))
        return jnp.where(self.labels > UNUSED, distance / steepest, jnp.inf)

    def part_labels(self, x: Float[AnyArray, "*n 3"]) -> Int[Array, "*n"]:
        """The label of the primitive with the nearest surface; exact for points on the solid's surface."""
        return self.labels[jnp.argmin(jnp.abs(self.distances(x)), axis=-1)]
