"""What the scanner asks of a surface: where rays hit it."""

from abc import abstractmethod

import equinox as eqx
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import AnyArray


class Hits(eqx.Module):
    """Where rays first meet a surface.

    - `points`: the hits, in scene coordinates; zero where the ray misses.
    - `normals`: unit normals on the side of the ray's origin; zero where the ray misses.
    - `mask`: whether the ray hits at all.
    """

    points: Float[Array, "rays 3"]
    normals: Float[Array, "rays 3"]
    mask: Bool[Array, "rays"]


class Surface(eqx.Module):
    """Anything that rays can hit.

    `in_jit` says whether `trace` runs under JAX transformations; a surface that needs host code says False.
    """

    in_jit: eqx.AbstractClassVar[bool]

    @abstractmethod
    def trace(self, origins: Float[AnyArray, "rays 3"], directions: Float[AnyArray, "rays 3"]) -> Hits:
        """First hits of the rays origin + t direction, t >= 0, with unit directions; of either side of the surface.

        A sensor sees only what faces it: an origin inside the surface sees the surface from within, its normals turned
        to the origin like all others.
        """
