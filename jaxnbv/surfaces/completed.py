"""A network that completes clouds, as an imagination: a mixture over what it says, and over a model that knows nothing.

A completion is a guess at the whole surface, as points. It becomes a solid, and the solids become shapes that stand in
the scene already: all else is as with known shapes, so that a guess which the scan contradicts has little weight, and
the samples of the others follow what was seen.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxnbv.checks import InputError, as_numbers, check_fields, is_traced, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import fibonacci_sphere
from jaxnbv.scanning.evidence import Evidence
from jaxnbv.scanning.sdf import solid_of_points
from jaxnbv.surfaces.base import SurfaceModel, SurfacePosterior
from jaxnbv.surfaces.known_shapes import KnownShapes, short_ranged
from jaxnbv.surfaces.registration import Seen, as_they_stand
from jaxnbv.surfaces.screened import ScreenedSPSR
from jaxnbv.surfaces.shape_bank import NUM_EXTREMES, Shape, ShapeBank, encoded

Completer = Callable[[PointCloud, PRNGKeyArray], Any]
"""From a cloud and a key to points (m, 3) all over a whole surface, both in scene coordinates."""


class Completed(SurfaceModel):
    """What a function says that the whole object looks like, where the scan does not contradict it.

    - `model`: of what none of the completions is.
    - `completer`: from a cloud and a key to points of a whole surface (`Completer`). It runs on the host, at
      `condition`, and may be a network of PyTorch.
    - `num_completions`: how often it is asked, each time with another key; a network that takes none is asked once.
    - `residual`: what samples may differ by from a completion, where the scan says so; short-ranged.
    - `sheet`: how thick a surface is that encloses nothing, in scene units.

    **Raises:** `ValueError` for a completer that is no function, or numbers out of their ranges.
    """

    model: SurfaceModel
    completer: Completer
    num_completions: int = eqx.field(static=True, default=1)
    residual: ScreenedSPSR = eqx.field(default_factory=short_ranged)
    sheet: float = eqx.field(static=True, default=0.05)

    def __check_init__(self):
        check_fields(self)
        require(self.num_completions >= 1, f"the completer is asked {self.num_completions} times; ask once at least")
        require(0 < self.sheet < 1, f"sheets are {self.sheet} thick; give scene units, above 0 and below 1")

    def check(self, cloud: PointCloud) -> None:
        """As that of the model without completions."""
        self.model.check(cloud)

    def condition(self, evidence: Evidence | PointCloud) -> SurfacePosterior:
        """p(f | evidence), the completer asked under fixed keys, so that the same evidence has the same posterior.

        **Raises:** `ValueError` within `jit`, and for a completer that returns anything but finite points (m, 3).
        """
        evidence = Evidence.of(evidence)
        if is_traced(evidence):
            raise InputError("a completer runs on the host: call condition outside jit")
        keys = jax.random.split(jax.random.key(0), self.num_completions)
        bank = _bank([self._completion(self.completer(evidence.cloud, key)) for key in keys])
        unknown = self.model.condition(evidence)
        shapes = KnownShapes(bank, self.residual, unknown=self.model)
        return shapes.given(as_they_stand(bank, Seen.of(evidence)), evidence, unknown)

    def _completion(self, answer: Any) -> Shape:
        try:
            points = as_numbers(answer, "its answer", np.float64)
            require(points.ndim == 2 and points.shape[1] == 3, f"its shape is {points.shape}")
            solid = solid_of_points(points, sheet=self.sheet)
        except InputError as error:
            raise InputError(f"the completer does not return points (m, 3) of a surface: {error}") from error
        directions = np.asarray(fibonacci_sphere(NUM_EXTREMES))
        return Shape(solid, jnp.asarray(points[np.argmax(points @ directions.T, axis=0)], jnp.result_type(float)))


def _bank(completions: list[Shape]) -> ShapeBank:
    joined = jax.tree.map(lambda *leaves: jnp.stack(leaves), *completions)
    names = [f"completion {number}" for number in range(1, len(completions) + 1)]
    return ShapeBank(joined.solid, joined.extremes, encoded(names))
