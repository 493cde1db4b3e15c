"""GridSurface: the level set of a function sampled on the regular grid that posterior samples are traced on."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxnbv.checks import require


class Grid(eqx.Module):
    """The regular grid of `resolution`^3 nodes that spans [-half_extent, half_extent]^3 of the scene.

    The defaults are the paper's: 100^3 nodes on [-1.75, 1.75]^3.
    """

    resolution: int = eqx.field(static=True, default=100)
    half_extent: float = eqx.field(static=True, default=1.75)

    def __check_init__(self):
        require(self.resolution >= 4, f"a grid of {self.resolution}^3 nodes is too small; it needs at least 4^3")
        require(self.half_extent > 0, f"the grid's half extent is {self.half_extent}; it must be positive")

    @property
    def spacing(self) -> float:
        """Distance between neighbouring nodes, in scene units."""
        return 2.0 * self.half_extent / (self.resolution - 1)

    @property
    def axis(self) -> Float[np.ndarray, " g"]:
        """Coordinates of the nodes along one axis."""
        return np.linspace(-self.half_extent, self.half_extent, self.resolution)
