"""The union of primitives that carry labels: one type for all such solids, so that one compiled program scans any."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.rotations import safe_norm
from jaxnbv.scanning.sdf.base import SignedDistance, corner_distance, least_of_last, nonnegative, parameter

# The label of a slot without a primitive.
UNUSED = -1


class LabelledSolid(SignedDistance):
    """The union of labelled primitives; a bound.

    A point x has the coordinates u = rotation^T (x - centre) in a primitive's own frame. With h = half_size and
    t = rounding, its distance is that of the box [-h, h] rounded by t,

        d(u) = |max(q, 0)| + min(max(q1, q2, q3), 0) - t,    q = |u| - (h - t),

    or, where `revolved`, the same in two dimensions of (r - radius - slant * u2, u2), r the distance from the axis u2,
    divided by the largest singular value (|slant| + sqrt(slant^2 + 4)) / 2 of this shear.

    - `centre`, `rotation`, `half_size`, `rounding`: as above, in scene units; a revolved one's half width is the first
      half size and its half height the second, and also the third.
    - `revolved`: which primitives are revolved; `radius` is then that of the ring, 0 for a solid, and `slant` its
      growth with height.
    - `labels`: the label of each primitive; -1 marks a slot that is not used.
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
        # R^T x written as sums, which XLA fuses with what follows where it would not a matrix product.
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
        """The label of the primitive whose surface is nearest: exact for points of the solid's surface."""
        return self.labels[jnp.argmin(jnp.abs(self.distances(x)), axis=-1)]
