"""The surface that pictures show: the likeliest known shape, or else the posterior mean."""

import dataclasses

from jaxnbv.observations import Observations
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.surfaces.known_shapes import KnownShapes, KnownShapesPosterior
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.utility import Answer
from jaxnbv.viz.mean_surface import MeanSurface, mean_surface, near_points
from jaxnbv.viz.placed_shape import likeliest_part, likeliest_shape, likely_kinds


def needs_no_posterior(sampler: SurfaceSampler) -> bool:
    """Return whether the model has a bank of known shapes, so that `shown_surface` needs no posterior."""
    return isinstance(sampler.model, KnownShapes) and sampler.model.bank.solids is not None


def shown_surface(sampler: SurfaceSampler, inputs: StepInputs, answer: Answer | None = None) -> MeanSurface | None:
    """Return the likeliest known shape at its placement, or else the posterior mean's surface near points.

    Return None if there is no such surface. If the object fits no known shape, the mean is that of the model without
    the bank, because a mean over several known shapes looks like none of them.

    - `inputs`: inputs of a step, with a posterior unless `needs_no_posterior`.
    - `answer`: the acquisition's answer, see `likely_kinds`.
    """
    observations, posterior, model = inputs.observations, inputs.posterior, sampler.model
    if isinstance(observations.hypotheses, PartHypotheses):
        return likeliest_part(observations.hypotheses, observations.cloud)
    if isinstance(model, KnownShapes) and needs_no_posterior(sampler):
        if isinstance(posterior, KnownShapesPosterior):
            fits, weights = posterior.fits, posterior.weights
        else:
            fits, weights = model.fit(_within_volume(sampler, observations))
        kinds = likely_kinds(model.bank, fits, weights, answer)
        if (shape := likeliest_shape(model.bank, fits, kinds, observations.cloud)) is not None:
            return shape
        sampler = sampler.without_bank
        of_none = posterior.of_none if isinstance(posterior, KnownShapesPosterior) else sampler.posterior(observations)
        inputs = StepInputs(observations, of_none)
    return near_points(mean_surface(sampler, inputs), observations.cloud)


def _within_volume(sampler: SurfaceSampler, observations: Observations) -> Observations:
    """Return the observations without the empty nodes outside the carving volume, which the model must not use."""
    observations = sampler.adapt(observations)
    if sampler.carving is None or observations.empty_nodes is None:
        return observations
    inside = observations.empty_nodes & sampler.carving.inside(sampler.grid)
    return dataclasses.replace(observations, empty_nodes=inside)
