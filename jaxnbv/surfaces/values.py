"""What is known of the function itself, beside its gradient: values of f relative to the level, at points.

Values are in units of h, half of how much the mean of f given the normals rises across the scanned sheet: the scale of
f is the prior's, and h is what it makes of the data.
"""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import InputError, check_fields, check_type, is_traced, native, own_settings, require, shown
from jaxnbv.geometry.cloud import farthest_point_subsample
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.geometry.volume import Box, Volume, boundary_points, bounding_box
from jaxnbv.observations import Observations
from jaxnbv.surfaces.base import HALF_WIDTH


class ValueRows(eqx.Module):
    """f(y_k) - c = value_k + e_k with e_k ~ N(0, noise_k^2), in units of h. Rows whose mask is False hold nothing.

    - `points`: in scene coordinates, within [-pi/2, pi/2]^3.

    **Raises:** `ValueError` for arrays of other shapes.
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
        """Check the filled rows, where their numbers are known.

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
        furthest = float(np.abs(points).max(initial=0.0))
        require(
            furthest <= float(points.dtype.type(HALF_WIDTH)),
            f"a value is given at a point with a coordinate of {furthest:.4g}, outside the scene, [-pi/2, pi/2]^3: "
            "mask the row, or bring the point there with Frame.to_scene",
        )


class ValueSource(eqx.Module):
    """A kind of knowledge about values of f."""

    @abstractmethod
    def rows(self, observations: Observations) -> ValueRows:
        """The rows that it adds, as many for all observations of one capacity; run under `jit`.

        A filled row outside [-pi/2, pi/2]^3 is refused when the model is conditioned; where that runs under `jit` too,
        its numbers cannot be checked, and the posterior is NaN.
        """


class OutsideBoundary(ValueSource):
    """f(b) - c ~ N(h, s_b^2) at points b on the boundary of the volume that holds the object (the "envelope" of Poisson
    reconstruction, Kazhdan et al. 2020, as an observation).

    - `volume`: see `jaxnbv.geometry.volume`; by default the box that scenes are scaled to.
    - `num_points`: points, spread evenly as seen from the origin.
    - `value`, `noise`: mean and standard deviation, in units of h.
    - `room`: how far outside the boundary the points lie, in scene units, as far as the scene goes: for a volume that
      may cut the object, which then does not close at the cut.

    **Raises:** `ValueError` for a count below one, noise that is not positive, negative room, or a boundary that leaves
    the scene, [-pi/2, pi/2]^3, or does not enclose the origin.
    """

    volume: Volume = Box()
    num_points: int = eqx.field(static=True, default=150)
    value: float = eqx.field(static=True, default=1.0)
    noise: float = eqx.field(static=True, default=0.5)
    room: float = eqx.field(static=True, default=0.0)

    @own_settings()
    def __check_init__(self):
        check_fields(self)
        require(0 <= self.room < math.inf, f"the room is {self.room}; it must be finite and not negative")
        _check(self.num_points, self.noise)
        if is_traced(self.volume):
            return
        with jax.ensure_compile_time_eval():
            try:
                about = bounding_box(self.volume)
                farthest = float(np.abs([about.low, about.high]).max())
                middle = float(self.volume(jnp.zeros((1, 3)))[0])
            except Exception as error:
                raise InputError(
                    f"the volume {shown(self.volume)} gives no signed distances of points (n, 3) ({error}): "
                    "give a Box or a solid of jaxnbv.sdf"
                ) from error
        require(middle < 0, f"the volume {self.volume} must enclose the origin, whose distance is {middle:.4g}")
        require(
            farthest <= HALF_WIDTH,
            f"the boundary of {self.volume} has a coordinate of {farthest:.4g}: it must lie within the scene, "
            "[-pi/2, pi/2]^3",
        )

    def rows(self, observations: Observations) -> ValueRows:
        points = boundary_points(self.volume, self.num_points, self.room).astype(observations.cloud.points.dtype)
        # The scene's own border, as a number of this type rounds it.
        points = jnp.clip(points, -HALF_WIDTH, HALF_WIDTH)
        return _rows(points, self.value, self.noise, jnp.ones(self.num_points, bool))


class OnSurface(ValueSource):
    """f(x_j) - c ~ N(0, s_f^2) at some of the data, farthest points (the "screening" of Kazhdan and Hoppe 2013).

    - `num_points`: how many, or all where there are fewer.
    - `noise`: standard deviation s_f, in units of h.

    **Raises:** `ValueError` for a count below one or noise that is not positive.
    """

    num_points: int = eqx.field(static=True, default=100)
    noise: float = eqx.field(static=True, default=0.1)

    def __check_init__(self):
        check_fields(self)
        _check(self.num_points, self.noise)

    def rows(self, observations: Observations) -> ValueRows:
        chosen = farthest_point_subsample(observations.cloud, self.num_points)
        return _rows(chosen.points, 0.0, self.noise, chosen.mask)


class SeenEmpty(ValueSource):
    """f(z) - c ~ N(value, s^2) with a positive value, at points z that were seen empty: what was not seen beside them
    is likely to be empty too. True of thin things such as furniture, false of a body whose hidden side is as large as
    the one that was seen.

    - `num_points`: how many, or all where there are fewer; farthest points.
    - `value`, `noise`: mean and standard deviation, in units of h.

    **Raises:** `ValueError` for a count below one or noise that is not positive.
    """

    num_points: int = eqx.field(static=True, default=150)
    value: float = eqx.field(static=True, default=2.0)
    noise: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        check_fields(self)
        _check(self.num_points, self.noise)

    def rows(self, observations: Observations) -> ValueRows:
        empty, seen = observations.empty_points
        mask = seen & jnp.all(jnp.abs(empty) <= HALF_WIDTH, axis=1)
        index = farthest_point_indices(empty, mask, self.num_points)
        kept = jnp.arange(self.num_points) < jnp.sum(mask)
        points = jnp.where(kept[:, None], empty[index], 0.0).astype(observations.cloud.points.dtype)
        return _rows(points, self.value, self.noise, kept)


def joined(sources: tuple[ValueSource, ...], observations: Observations) -> ValueRows:
    """The rows of all sources, one behind the other, with zeros in those that are not filled.

    **Raises:** `ValueError` for a source that gives no rows of values.
    """
    parts = [source.rows(observations) for source in sources]
    for source, part in zip(sources, parts, strict=True):
        check_type(part, ValueRows, f"what {type(source).__name__}.rows gives")
    rows = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    # Whatever stands in the others, NaN included, must not reach the products.
    points = jnp.where(rows.mask[:, None], rows.points, 0.0)
    values, noise = (jnp.where(rows.mask, leaf, 0.0) for leaf in (rows.values, rows.noise))
    return ValueRows(points, values, noise, rows.mask)


def _rows(points, value: float, noise: float, mask) -> ValueRows:
    one = jnp.ones(len(points), points.dtype)
    return ValueRows(points, value * one, noise * one, mask)


def _check(num_points: int, noise: float) -> None:
    require(num_points >= 1, f"the number of values is {num_points}; it must be at least 1")
    require(0 < noise < math.inf, f"the noise of the values is {noise}; it must be positive and finite")
