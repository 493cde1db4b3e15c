"""A mixture prior: a known shape of a bank plus a Gaussian process, or none of the shapes.

    prior      f = m_i + g for fit i, with g a Gaussian process, the residual;   for i = 0, f from `model_of_none`
    mean       m_i = h tanh(d_i / h), with d_i the signed distance of the placed shape
    weights    w_i proportional to exp(-beta E_i)
    sample     i by systematic resampling of w, then f from its posterior given i

Fit i (also called a hypothesis) is a shape of the bank with a placement, and i = 0 is "none of these". A shape may have
several fits, but only distinct fits (`Hypotheses.is_distinct`) have a weight. h is half the rise of f across the
surface, the unit of values in `ScreenedSPSR`. E_i is the misfit of fit i to the scan (`surfaces/registration.py`), and
E_0 is `misfit_of_none`. beta is small enough to keep several shapes possible. A likelihood that treats thousands of
normals as independent would always select one shape. Weights of parts at true size are in `surfaces/part_evidence.py`.
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
from jaxnbv.programs import program
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.sharding import shared_map
from jaxnbv.surfaces.base import Fields, SurfaceModel, SurfacePosterior, sampling_method
from jaxnbv.surfaces.part_hypotheses import NONE, PartHypotheses, hypotheses_of, identify
from jaxnbv.surfaces.placement import FreeRotation, Placement, ShapePoses
from jaxnbv.surfaces.registration import FitTargets, Hypotheses, Prior, register
from jaxnbv.surfaces.screened import ScreenedSPSR, ScreenedSPSRPosterior
from jaxnbv.surfaces.shape_bank import ShapeBank
from jaxnbv.surfaces.spsr import GeometricSPSR
from jaxnbv.surfaces.values import OnSurface


def short_ranged(longest_side: float = 2.5, truncation: int = 32) -> ScreenedSPSR:
    """Return the default model of the difference between an object and a known shape.

    - `longest_side`: longest side of the object's bounding box, in scene units.
    - `truncation`: upper limit of the model's truncation, which rises for smaller objects.
    """
    scale = longest_side / 2.5
    # Long lengthscales, or values at points off the surface, would change the shape far from the scan. `noise` covers
    # errors of the shape's normals: near an edge, a slightly misplaced shape has the normals of the wrong face.
    # `level_deviation` is small, because the shape's surface has level zero. The noise of `OnSurface` covers errors of
    # the placement.
    base = GeometricSPSR(0.01 * scale, truncation=min(round(32 / scale), truncation), noise=0.2)
    return ScreenedSPSR(base, (OnSurface(noise=0.3),), level_deviation=0.02, offset=0.1 * scale)


class KnownShapes(SurfaceModel):
    """A mixture prior of known shapes, which are registered to the scan, and a model for "none of these".

    - `residual`: the model of the difference between object and shape. Its lengthscale is short, so a scanned point
      changes the shape only nearby.
    - `poses`: the possible placements of shapes in the scene.
    - `box`: a tight box around the object.
    - `model_of_none`: the model for an object that is none of the shapes. With an empty bank this is the whole model.
    - `num_starts`: number of placements tried, all shapes together.
    - `noise_scale`: factor on the residual's standard deviation. With 1, the large prior deviation in unseen space
      breaks thin pieces of sampled surface and adds floating fragments near them.
    - `inverse_temperature`: beta. The weight of a shape with misfit E is proportional to exp(-beta E).
    - `misfit_of_none`: the misfit at which a shape is as likely as "none of these".

    **Raises:** `ValueError` for a number out of its range.
    """

    bank: ShapeBank
    residual: ScreenedSPSR = eqx.field(default_factory=short_ranged)
    poses: ShapePoses = FreeRotation()
    box: Box = Box()
    model_of_none: SurfaceModel = eqx.field(default_factory=ScreenedSPSR)
    num_starts: int = eqx.field(static=True, default=4096)
    noise_scale: float = eqx.field(static=True, default=0.1)
    inverse_temperature: float = eqx.field(static=True, default=20.0)
    misfit_of_none: float = eqx.field(static=True, default=0.6)

    def __check_init__(self):
        check_fields(self)
        require(self.num_starts >= 1, f"num_starts is {self.num_starts}; it must be at least 1")
        for name in ("inverse_temperature", "noise_scale"):
            value = getattr(self, name)
            require(0 <= value < math.inf, f"{name} is {value}; it must be finite and not negative")

    def check(self, cloud: PointCloud) -> None:
        self.model_of_none.check(cloud)

    @property
    def carries_hypotheses(self) -> bool:
        """Whether `add_state` adds `PartHypotheses`: only for a bank with parts at true size."""
        return self.bank.is_true_size and self.bank.solids is not None

    def in_scene(self, frame: Frame) -> "KnownShapes":
        return dataclasses.replace(self, bank=self.bank.in_scene(frame))

    def add_state(self, observations: Observations) -> Observations:
        """Return the observations, with `PartHypotheses` added if the bank has parts at true size."""
        if not self.carries_hypotheses:
            return observations
        previous = observations.hypotheses
        assert previous is None or isinstance(previous, PartHypotheses)
        return dataclasses.replace(
            observations, hypotheses=identify(self.bank, self.poses, self.box, observations, previous)
        )

    def fit(self, observations: Observations) -> tuple[Hypotheses, Float[Array, " h_and_none"]]:
        """Return the shapes registered to the scan, and their weights. The last weight is for "none of these"."""
        fits = register(self.bank, Prior(self.poses, self.box), FitTargets.of(observations), self.num_starts)
        return fits, _weights(fits, self.inverse_temperature, self.misfit_of_none)

    def condition(self, observations: Observations | PointCloud) -> SurfacePosterior:
        """Return the posterior p(f | observations).

        The shapes are registered to the cloud and to the space that was seen to be empty.

        **Raises:** `ValueError` if the `condition` of `residual` or of `model_of_none` raises it.
        """
        observations = as_observations(observations)
        of_none = self.model_of_none.condition(observations)
        if self.bank.solids is None:
            return of_none
        if self.carries_hypotheses:
            is_added = observations.hypotheses is not None
            hypotheses = hypotheses_of(observations if is_added else self.add_state(observations))
            fits, weights, misfit_of_none = hypotheses.placed, hypotheses.weights, hypotheses.misfit_of_none
        else:
            fits, weights = self.fit(observations)
            misfit_of_none = jnp.asarray(self.misfit_of_none, fits.misfit.dtype)
        residual, zero = self.residual.condition(observations), jnp.zeros_like(of_none.level)
        return KnownShapesPosterior(zero, self, fits, weights, misfit_of_none, residual, of_none)


@program
def _weights(fits: Hypotheses, inverse_temperature: float, misfit_of_none: float) -> Float[Array, " h_and_none"]:
    misfit = jnp.append(fits.misfit, misfit_of_none)
    return jax.nn.softmax(-inverse_temperature * misfit, where=jnp.append(fits.is_distinct, True))


class Hypothesis(NamedTuple):
    """A possible identity of the object. The placement of "none of these" is None."""

    name: str
    weight: float
    misfit: float
    placement: Placement | None


class KnownShapesPosterior(SurfacePosterior):
    """The posterior p(f | D) under `KnownShapes`.

    - `level`: zero.
    - `fits`: the shapes registered to the scan.
    - `weights`: probability of each fit, followed by the probability of "none of these".
    - `misfit_of_none`: misfit of "none of these".
    - `residual`: posterior of the difference between object and shape.
    - `of_none`: posterior of f if the object is none of the shapes.
    """

    level: Float[Array, ""]
    model: KnownShapes
    fits: Hypotheses
    weights: Float[Array, " h_and_none"]
    misfit_of_none: Float[Array, ""]
    residual: ScreenedSPSRPosterior
    of_none: SurfacePosterior

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """The hypotheses, including "none of these", most likely first."""
        # Transfer all rows to the host at once.
        fits, weights = jax.tree.map(np.asarray, self.fits), np.asarray(self.weights)
        names = self.model.bank.names
        hypotheses = [
            Hypothesis(
                names[fits.shape[row]],
                float(weights[row]),
                float(fits.misfit[row]),
                jax.tree.map(lambda rows, row=row: rows[row], self.fits.placement),
            )
            for row in np.flatnonzero(fits.is_distinct)
        ]
        none = Hypothesis(NONE, float(weights[-1]), float(self.misfit_of_none), None)
        return sorted([*hypotheses, none], key=lambda one: -one.weight)

    def kinds(self) -> dict[str, float]:
        """Return the probability of each kind of shape, most likely first.

        "chair 3" and "chair 12" are of the kind "chair". "None of these" is a kind too.
        """
        weights: dict[str, float] = {}
        for one in self.hypotheses:
            kind = kind_of(one.name)
            weights[kind] = weights.get(kind, 0.0) + one.weight
        return dict(sorted(weights.items(), key=lambda item: -item[1]))

    def given(self, row: int) -> "KnownShapesPosterior":
        """Return the posterior given that the fit with this row is right."""
        weights = np.eye(len(self.weights), dtype=self.weights.dtype)[row]
        return dataclasses.replace(self, weights=jnp.asarray(weights))

    def names_of_samples(self, key: PRNGKeyArray, num_samples: int) -> list[str]:
        """Return the name of the shape of each sample that `sample` draws with this key."""
        bank_names = self.model.bank.names
        names = [*(bank_names[index] for index in np.asarray(self.fits.shape)), NONE]
        return [names[index] for index in np.asarray(_draw_indices(self, key, num_samples))]

    @sampling_method
    def sample(self, key: PRNGKeyArray, num_samples: int) -> "MixtureFields":
        """Draw `num_samples` samples of f. Systematic resampling draws the shapes of all samples jointly."""
        return _sample(self, key, num_samples)


@program
def _sample(posterior: KnownShapesPosterior, key: PRNGKeyArray, num_samples: int) -> "MixtureFields":
    _, residual_key, none_key = jax.random.split(key, 3)
    fits, bank = posterior.fits, posterior.model.bank
    index = _draw_indices(posterior, key, num_samples)
    is_none = index == len(fits.shape)
    row = jnp.where(is_none, 0, index)
    solids = bank.shape(fits.shape[row]).solid
    placement = jax.tree.map(lambda rows: rows[row], fits.placement)
    means = PlacedShapes(solids, placement, posterior.residual.value_unit)
    shape_fields = posterior.residual.sample_about(means, residual_key, posterior.model.noise_scale)

    def draw():
        return posterior.of_none.sample(none_key, num_samples)

    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), eqx.filter_eval_shape(draw))
    of_none = jax.lax.cond(jnp.any(is_none), draw, lambda: zeros)
    return MixtureFields(shape_fields, of_none, posterior.of_none.level, is_none)


@program
def _draw_indices(posterior: KnownShapesPosterior, key: PRNGKeyArray, num_samples: int) -> Int[Array, " s"]:
    """Draw the row of `posterior.fits` for each sample. The number of rows stands for "none of these"."""
    shape_key, order_key = jax.random.split(jax.random.split(key, 3)[0])
    index = systematic_resampling(shape_key, posterior.weights, num_samples)
    # The indices are sorted. Shuffle them, because the first few samples should vary as much as all.
    return jax.random.permutation(order_key, index)


def kind_of(name: str) -> str:
    """Return the kind of a shape, which is its name without the trailing number."""
    head, _, last = name.rpartition(" ")
    return head if head and last.isdigit() else name


def systematic_resampling(
    key: PRNGKeyArray, weights: Float[Array, " n"], num_samples: int
) -> Int[Array, " num_samples"]:
    """Draw sorted indices with probabilities proportional to weights (Kitagawa 1996).

    How often an index is drawn differs from its expected count by less than one.
    """
    positions = (jnp.arange(num_samples) + jax.random.uniform(key)) / num_samples
    total = jnp.cumsum(weights)
    return jnp.clip(jnp.searchsorted(total / total[-1], positions, side="right"), 0, len(weights) - 1)


class PlacedShapes(Fields):
    """The fields h tanh(d / h), where d is the signed distance of a placed solid.

    They are bounded by h, and at the surface their gradient equals that of d.

    - `solids`, `placements`: one for each sample, along a leading axis.
    - `bound`: h, in scene units.
    """

    solids: SignedDistance
    placements: Placement
    bound: Float[Array, ""]

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        def values(shape, x, bound):
            solid, placement = shape
            return bound * jnp.tanh(placement.distance(solid, x) / bound)

        return shared_map(values, (self.solids, self.placements), jnp.asarray(x), self.bound)


class MixtureFields(Fields):
    """A batch of samples in which each sample comes from one of two batches of the same size.

    - `level`: the level of `of_none`, which is subtracted from its values, so that every surface is at zero.
    - `is_none`: for each sample, whether it comes from `of_none`.
    """

    of_shapes: Fields
    of_none: Fields
    level: Float[Array, ""]
    is_none: Bool[Array, " s"]

    def __call__(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n"]:
        return self._merge(lambda fields: fields(x))

    def gradient(self, x: Float[AnyArray, "n 3"]) -> Float[Array, "s n 3"]:
        return self._merge(lambda fields: fields.gradient(x), relative=False)

    def on_grid(self, axis: Float[AnyArray, " g"]) -> Float[Array, "s g g g"]:
        return self._merge(lambda fields: fields.on_grid(axis))

    def _merge(self, evaluate: Any, relative: bool = True) -> Array:
        shape = jax.eval_shape(lambda: evaluate(self.of_shapes))
        zero = jnp.zeros(shape.shape, shape.dtype)
        # Do not evaluate a batch that contributes no sample.
        from_shapes = jax.lax.cond(jnp.all(self.is_none), lambda: zero, lambda: evaluate(self.of_shapes))
        from_none = jax.lax.cond(jnp.any(self.is_none), lambda: evaluate(self.of_none), lambda: zero)
        is_none = self.is_none.reshape(-1, *(1,) * (zero.ndim - 1))
        return jnp.where(is_none, from_none - self.level if relative else from_none, from_shapes)
