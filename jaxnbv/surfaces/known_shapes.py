"""Known shapes as the prior: a mixture over a bank, registered to the scan, with a Gaussian process as the residual.

    prior      f = m_k(T^-1 x) + g,   k ~ pi over shapes 1..K and 0 for none of these,   g a Gaussian process
    mean       m_k = h tanh(d_k / h), d_k the signed distance, h half the residual's jump across the surface
    weights    w_k proportional to exp(-beta E_k) over the modes of the fit,  w_0 to exp(-beta E_0)
    sample     shapes by systematic resampling of w; then f about the mean m_k, or for k = 0 a sample of the model that
               knows no shapes

The weights are tempered: the likelihood of thousands of normals, which are not independent, would always choose one.
See `surfaces/registration.py` for E.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray, check_fields, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.volume import Box
from jaxnbv.observations import Observations, as_observations
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.base import Fields, SurfaceModel, SurfacePosterior, sampling_method
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses, identify
from jaxnbv.surfaces.placement import FreeRotation, Placement, ShapePoses
from jaxnbv.surfaces.registration import Hypotheses, Prior, Seen, register
from jaxnbv.surfaces.screened import ScreenedSPSR, ScreenedSPSRPosterior
from jaxnbv.surfaces.shape_bank import ShapeBank
from jaxnbv.surfaces.spsr import GeometricSPSR
from jaxnbv.surfaces.values import OnSurface


def short_ranged(longest_side: float = 2.5, truncation: int = 32) -> ScreenedSPSR:
    """The usual residual, for an object whose box has this longest side, in scene units.

    - `truncation`: the most frequencies along an axis.
    """
    scale = longest_side / 2.5
    # With long scales, or values beside the surface, it pulls the surface back to what it would say by itself. The
    # noise is that of the shape's normals: beside an edge that is a little off, they are those of the other face. The
    # level is that of the shape, and values are known no better than where it was put.
    base = GeometricSPSR(0.01 * scale, truncation=min(round(32 / scale), truncation), noise=0.2)
    return ScreenedSPSR(base, (OnSurface(noise=0.3),), level_deviation=0.02, offset=0.1 * scale)


class KnownShapes(SurfaceModel):
    """A mixture over known shapes that fit what was seen, and a model that knows none.

    - `bank`: the shapes.
    - `residual`: what samples may differ by from the shape, where the scan says so; short-ranged.
    - `poses`: how shapes can stand in the scene; `box`: what holds the object, and no more than it needs.
    - `unknown`: the model of what none of the shapes is.
    - `num_starts`: placements that are tried, over all shapes.
    - `noise_scale`: rho, of the residual's deviation where nothing was seen; one as large as the prior's breaks thin
      parts and lets pieces float about them.
    - `inverse_temperature`: beta; `misfit_of_none`: E_0, the misfit at which a shape is as likely as none.

    With an empty bank it is `unknown`.

    **Raises:** `ValueError` for a number out of its range.
    """

    bank: ShapeBank
    residual: ScreenedSPSR = eqx.field(default_factory=short_ranged)
    poses: ShapePoses = FreeRotation()
    box: Box = Box()
    unknown: SurfaceModel = eqx.field(default_factory=ScreenedSPSR)
    num_starts: int = eqx.field(static=True, default=4096)
    noise_scale: float = eqx.field(static=True, default=0.1)
    inverse_temperature: float = eqx.field(static=True, default=20.0)
    misfit_of_none: float = eqx.field(static=True, default=0.6)

    def __check_init__(self):
        check_fields(self)
        require(self.num_starts >= 1, f"the number of starts is {self.num_starts}; it must be at least 1")
        for name, value in (("inverse_temperature", self.inverse_temperature), ("noise scale", self.noise_scale)):
            require(0 <= value < math.inf, f"the {name} is {value}; it must be finite and not negative")

    def check(self, cloud: PointCloud) -> None:
        self.unknown.check(cloud)

    @property
    def carries_hypotheses(self) -> bool:
        """For parts at true size."""
        return self.bank.is_true_size and self.bank.solids is not None

    def in_scene(self, frame: Frame) -> "KnownShapes":
        return dataclasses.replace(self, bank=self.bank.in_scene(frame))

    def observed(self, observations: Observations) -> Observations:
        """The observations with the `PartHypotheses` of parts at true size."""
        if not self.carries_hypotheses:
            return observations
        before = observations.hypotheses
        assert before is None or isinstance(before, PartHypotheses)
        return dataclasses.replace(
            observations, hypotheses=identify(self.bank, self.poses, self.box, observations, before)
        )

    def condition(self, observations: Observations | PointCloud) -> SurfacePosterior:
        """p(f | observations), the shapes registered to its cloud and to the space that was seen empty.

        **Raises:** `ValueError` as the `condition` of `residual` and `unknown` does.
        """
        observations = as_observations(observations)
        unknown = self.unknown.condition(observations)
        if self.bank.solids is None:
            return unknown
        if self.carries_hypotheses:
            hypotheses = (
                self.observed(observations).hypotheses if observations.hypotheses is None else observations.hypotheses
            )
            assert isinstance(hypotheses, PartHypotheses)
            found, weights = hypotheses.placed, hypotheses.weights
        else:
            found = register(self.bank, Prior(self.poses, self.box), Seen.of(observations), self.num_starts)
            weights = _weights(found, self.inverse_temperature, self.misfit_of_none)
        return KnownShapesPosterior(
            jnp.zeros_like(unknown.level), self, found, weights, self.residual.condition(observations), unknown
        )


@eqx.filter_jit
def _weights(found: Hypotheses, inverse_temperature: float, misfit_of_none: float) -> Float[Array, " h_and_none"]:
    misfit = jnp.append(found.misfit, misfit_of_none)
    return jax.nn.softmax(-inverse_temperature * misfit, where=jnp.append(found.is_mode, True))


class Hypothesis(NamedTuple):
    """What the object may be: a shape's name, how likely it is, how well it fits, and where it stands."""

    name: str
    weight: float
    misfit: float
    placement: Placement | None


class KnownShapesPosterior(SurfacePosterior):
    """p(f | D) under `KnownShapes`.

    - `level`: zero.
    - `found`: the shapes that were registered.
    - `weights`: of each of them, and last of none.
    - `residual`: p(g | D), about which samples are drawn; `unknown`: p(f | D, none of the shapes).
    """

    level: Float[Array, ""]
    model: KnownShapes
    found: Hypotheses
    weights: Float[Array, " h_and_none"]
    residual: ScreenedSPSRPosterior
    unknown: SurfacePosterior

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """What the object may be, most likely first, "none of these" among it."""
        # On the host at once, not row by row.
        found, weights = jax.tree.map(np.asarray, self.found), np.asarray(self.weights)
        names = self.model.bank.names
        known = [
            Hypothesis(
                names[found.shape[row]],
                float(weights[row]),
                float(found.misfit[row]),
                jax.tree.map(lambda rows, row=row: rows[row], self.found.placement),
            )
            for row in np.flatnonzero(found.is_mode)
        ]
        none = Hypothesis(NONE, float(weights[-1]), self.model.misfit_of_none, None)
        return sorted([*known, none], key=lambda one: -one.weight)

    def kinds(self) -> dict[str, float]:
        """How likely each kind of shape is, most likely first: "chair 3" and "chair 12" are of one kind."""
        found: dict[str, float] = {}
        for one in self.hypotheses:
            kind = kind_of(one.name)
            found[kind] = found.get(kind, 0.0) + one.weight
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def names_of_samples(self, key: PRNGKeyArray, num_samples: int) -> list[str]:
        """Which shapes the samples of `sample` are about."""
        of_bank = self.model.bank.names
        names = [*(of_bank[index] for index in np.asarray(self.found.shape)), NONE]
        return [names[index] for index in np.asarray(_drawn(self, key, num_samples))]

    @sampling_method
    def sample(self, key: PRNGKeyArray, num_samples: int) -> "MixtureFields":
        """`num_samples` samples of f; which shapes they are about is drawn jointly, by systematic resampling."""
        return _sample(self, key, num_samples)


@eqx.filter_jit
def _sample(posterior: KnownShapesPosterior, key: PRNGKeyArray, num_samples: int) -> "MixtureFields":
    _, residual_key, unknown_key = jax.random.split(key, 3)
    found, bank = posterior.found, posterior.model.bank
    index = _drawn(posterior, key, num_samples)
    is_none = index == len(found.shape)
    row = jnp.where(is_none, 0, index)
    solids = bank.shape(found.shape[row]).solid
    placement = jax.tree.map(lambda rows: rows[row], found.placement)
    means = PlacedShapes(solids, placement, posterior.residual.half_jump)
    known = posterior.residual.sample_about(means, residual_key, posterior.model.noise_scale)

    def draw():
        return posterior.unknown.sample(unknown_key, num_samples)

    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), eqx.filter_eval_shape(draw))
    unknown = jax.lax.cond(jnp.any(is_none), draw, lambda: nothing)
    return MixtureFields(known, unknown, posterior.unknown.level, is_none)


@eqx.filter_jit
def _drawn(posterior: KnownShapesPosterior, key: PRNGKeyArray, num_samples: int) -> Int[Array, " s"]:
    """The hypothesis that each sample is about; the last is none."""
    shape_key, order_key = jax.random.split(jax.random.split(key, 3)[0])
    index = systematic_resampling(shape_key, posterior.weights, num_samples)
    # The first few samples are no different from the rest.
    return jax.random.permutation(order_key, index)


def kind_of(name: str) -> str:
    """A shape's name without its number."""
    head, _, last = name.rpartition(" ")
    return head if head and last.isdigit() else name


def systematic_resampling(
    key: PRNGKeyArray, weights: Float[Array, " n"], num_samples: int
) -> Int[Array, " num_samples"]:
    """Indices so that each is drawn as often as its weight says, but for less than one (Kitagawa 1996)."""
    places = (jnp.arange(num_samples) + jax.random.uniform(key)) / num_samples
    total = jnp.cumsum(weights)
    return jnp.clip(jnp.searchsorted(total / total[-1], places, side="right"), 0, len(weights) - 1)


class PlacedShapes(Fields):
    """h tanh(d / h) of solids, each where it was placed: as steep as the distance at the surface, and bounded.

    - `solids`, `placements`: with a leading axis.
    - `width`: h, in scene units.
    """

    solids: SignedDistance
    placements: Placement
    width: Float[Array, ""]

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        def one(placed, x, width):
            solid, placement = placed
            return width * jnp.tanh(placement.distance(solid, x) / width)

        return shared_map(one, (self.solids, self.placements), jnp.asarray(x), self.width)


class MixtureFields(Fields):
    """Samples each of which is of one of two kinds.

    - `known`, `unknown`: as many of both; `level`: that of the unknown, which is taken from it.
    - `is_unknown`: which kind each is of.
    """

    known: Fields
    unknown: Fields
    level: Float[Array, ""]
    is_unknown: Bool[Array, " s"]

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        return self._merged(lambda fields: fields(x))

    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        return self._merged(lambda fields: fields.gradient(x), relative=False)

    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        return self._merged(lambda fields: fields.on_grid(axis))

    def _merged(self, evaluate: Any, relative: bool = True) -> Array:
        shape = jax.eval_shape(lambda: evaluate(self.known))
        zero = jnp.zeros(shape.shape, shape.dtype)
        # What is asked of none is not computed.
        known = jax.lax.cond(jnp.all(self.is_unknown), lambda: zero, lambda: evaluate(self.known))
        unknown = jax.lax.cond(jnp.any(self.is_unknown), lambda: evaluate(self.unknown), lambda: zero)
        which = self.is_unknown.reshape(-1, *(1,) * (zero.ndim - 1))
        return jnp.where(which, unknown - self.level if relative else unknown, known)
