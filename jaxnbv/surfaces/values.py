"""Sources of observed values of f relative to its level, in addition to the observed normals.

Values are in units of h, because the scale of f depends on the prior. h is half the rise of E f across the scanned
surface, given the normals alone (see `ScreenedSPSR.offset`).
"""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import InputError, check_fields, check_type, is_traced, native, own_settings, require, short_text
from jaxnbv.geometry.cloud import farthest_point_subsample
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.geometry.volume import Box, Volume, boundary_points, bounding_box, check_encloses_origin
from jaxnbv.observations import Observations
from jaxnbv.surfaces.base import HALF_WIDTH


class ValueRows(eqx.Module):
    """Observed values of f - c at points, with independent normal noise. The surface is where f = c.

    The unit of values and noise is h, see `ScreenedSPSR.offset`.

    - `points`: where f is observed, in scene coordinates, within [-pi/2, pi/2]^3.
    - `values`, `noise`: observed values of f - c, positive outside the object, and their standard deviations.
    - `mask`: False for rows that are padding.

    **Raises:** `ValueError` for arrays whose shapes differ from the annotated shapes.
    """

    points: Float[Array, "m 3"] = eqx.field(converter=native)
    values: Float[Array, " m"] = eqx.field(converter=native)
    noise: Float[Array, " m"] = eqx.field(converter=native)
    mask: Bool[Array, " m"]

    def __check_init__(self):
        shapes = tuple(jnp.shape(leaf) for leaf in (self.points, self.values, self.noise, self.mask))
        rows = shapes[1]
        require(
            len(rows) == 1 and shapes == ((*rows, 3), rows, rows, rows),
            f"rows of values have points, values, noise and mask of shapes {shapes}: give (m, 3), (m,), (m,) and (m,)",
        )

    def check(self) -> None:
        """Check the filled rows. Under `jit` this does nothing.

        **Raises:** `ValueError` for numbers that are not finite, negative noise, or a point outside [-pi/2, pi/2]^3.
        """
        if is_traced(self):
            return
        mask = np.asarray(self.mask)
        points, values, noise = (np.asarray(leaf)[mask] for leaf in (self.points, self.values, self.noise))
        for name, numbers in (("points", points), ("values", values), ("noise", noise)):
            require(
                bool(np.isfinite(numbers).all()), f"rows of values have {name} that are not finite: mask these rows"
            )
        require(
            bool((noise >= 0).all()), f"a value has a noise of {noise.min(initial=0.0):.4g}; it must not be negative"
        )
        largest = float(np.abs(points).max(initial=0.0))
        require(
            largest <= float(points.dtype.type(HALF_WIDTH)),
            f"a value is given at a point with a coordinate of {largest:.4g}, outside the scene, [-pi/2, pi/2]^3: "
            "mask the row, or bring the point there with Frame.to_scene",
        )


class ValueSource(eqx.Module):
    """Base class of sources of observed values of f. Subclasses define `rows`."""

    @abstractmethod
    def rows(self, observations: Observations) -> ValueRows:
        """Return the observed values that this source adds.

        The method is called under `jit`, so the number of rows may depend only on the capacity of the cloud. The points
        of filled rows must lie in [-pi/2, pi/2]^3. Otherwise the model's `condition` raises `ValueError`, or under
        `jit` the posterior is NaN.
        """


class OutsideBoundary(ValueSource):
    """Positive values of f minus its level on the boundary of the volume that holds the object.

    These values place the boundary outside the object, like the "envelope" of Kazhdan et al. (2020).

    - `volume`: see `jaxnbv.geometry.volume`; by default the box to which scenes are scaled.
    - `num_points`: number of points, spread evenly as seen from the origin.
    - `value`, `noise`: observed value and its standard deviation, in units of h, see `ScreenedSPSR.offset`.
    - `margin`: distance from the boundary to the points, outward, in scene units. Points are clipped to the scene. Give
      a positive distance if the volume cuts the object. Otherwise sampled objects would close at the cut.

    **Raises:** `ValueError` for a count below one, noise that is not positive, a negative margin, or a boundary that
    leaves the scene, [-pi/2, pi/2]^3, or does not enclose the origin.
    """

    volume: Volume = Box()
    num_points: int = eqx.field(static=True, default=150)
    value: float = eqx.field(static=True, default=1.0)
    noise: float = eqx.field(static=True, default=0.5)
    margin: float = eqx.field(static=True, default=0.0)

    @own_settings()
    def __check_init__(self):
        check_fields(self)
        require(0 <= self.margin < math.inf, f"the margin is {self.margin}; it must be finite and not negative")
        _check(self.num_points, self.noise)
        if is_traced(self.volume):
            return
        with jax.ensure_compile_time_eval():
            try:
                check_encloses_origin(self.volume)
                bounds = bounding_box(self.volume)
                largest = float(np.abs([bounds.low, bounds.high]).max())
            except InputError:
                raise
            except Exception as error:
                raise InputError(
                    f"the volume {short_text(self.volume)} gives no signed distances of points (n, 3) ({error}): "
                    "give a Box or a solid of jaxnbv.sdf"
                ) from error
        require(
            largest <= HALF_WIDTH,
            f"the boundary of {self.volume} has a coordinate of {largest:.4g}: it must lie within the scene, "
            "[-pi/2, pi/2]^3",
        )

    def rows(self, observations: Observations) -> ValueRows:
        points = boundary_points(self.volume, self.num_points, self.margin).astype(observations.cloud.points.dtype)
        # The margin, or rounding in this dtype, may put points beyond the scene.
        points = jnp.clip(points, -HALF_WIDTH, HALF_WIDTH)
        return _rows(points, self.value, self.noise, jnp.ones(self.num_points, bool))


class OnSurface(ValueSource):
    """Values of zero for f minus its level at points of the cloud: "screening" (Kazhdan and Hoppe 2013).

    - `num_points`: number of points, chosen by farthest point sampling. If the cloud has fewer points, all are used.
    - `noise`: standard deviation of the values, in units of h, see `ScreenedSPSR.offset`.

    **Raises:** `ValueError` for a count below one or noise that is not positive.
    """

    num_points: int = eqx.field(static=True, default=100)
    noise: float = eqx.field(static=True, default=0.1)

    def __check_init__(self):
        check_fields(self)
        _check(self.num_points, self.noise)

    def rows(self, observations: Observations) -> ValueRows:
        cloud = farthest_point_subsample(observations.cloud, self.num_points)
        return _rows(cloud.points, 0.0, self.noise, cloud.mask)


class EmptySpace(ValueSource):
    """Positive values of f minus its level at points that were seen to be empty.

    The positive value makes unseen space next to empty space likely to be empty too. This assumption holds for thin
    objects such as furniture, but not for a body whose hidden side is as large as its visible side.

    - `num_points`: number of points, chosen by farthest point sampling. If there are fewer empty points, all are used.
    - `value`, `noise`: observed value and its standard deviation, in units of h, see `ScreenedSPSR.offset`.

    **Raises:** `ValueError` for a count below one or noise that is not positive.
    """

    num_points: int = eqx.field(static=True, default=150)
    value: float = eqx.field(static=True, default=2.0)
    noise: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check_fields(self)
        _check(self.num_points, self.noise)

    def rows(self, observations: Observations) -> ValueRows:
        nodes, is_empty = observations.empty_points
        mask = is_empty & jnp.all(jnp.abs(nodes) <= HALF_WIDTH, axis=1)
        index = farthest_point_indices(nodes, mask, self.num_points)
        is_filled = jnp.arange(self.num_points) < jnp.sum(mask)
        points = jnp.where(is_filled[:, None], nodes[index], 0.0).astype(observations.cloud.points.dtype)
        return _rows(points, self.value, self.noise, is_filled)


def concatenate_rows(sources: tuple[ValueSource, ...], observations: Observations) -> ValueRows:
    """Concatenate the rows of all sources, with zeros in unfilled rows.

    **Raises:** `ValueError` if a source does not return `ValueRows`.
    """
    parts = [source.rows(observations) for source in sources]
    for source, part in zip(sources, parts, strict=True):
        check_type(part, ValueRows, f"the result of {type(source).__name__}.rows")
    rows = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    # Unfilled rows may hold NaN. Set them to zero, because NaN would spread through products.
    points = jnp.where(rows.mask[:, None], rows.points, 0.0)
    values, noise = (jnp.where(rows.mask, leaf, 0.0) for leaf in (rows.values, rows.noise))
    return ValueRows(points, values, noise, rows.mask)


def _rows(points, value: float, noise: float, mask) -> ValueRows:
    ones = jnp.ones(len(points), points.dtype)
    return ValueRows(points, value * ones, noise * ones, mask)


def _check(num_points: int, noise: float) -> None:
    require(num_points >= 1, f"the number of values is {num_points}; it must be at least 1")
    require(0 < noise < math.inf, f"the noise of the values is {noise}; it must be positive and finite")
