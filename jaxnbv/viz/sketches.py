"""What costs most of an episode's pictures, drawn step by step while what a step imagined is at hand."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import Step, view_keys
from jaxnbv.sampler import StepInputs
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.viz.imagined import Imagined, imagined
from jaxnbv.viz.mean_surface import MeanSurface, as_shown, mean_surface
from jaxnbv.viz.placed_part import likeliest_part
from jaxnbv.viz.unmeasured import Patch, unmeasured


class Sketch(NamedTuple):
    """What a step knew before its view was taken.

    - `surface`: of the likeliest part, where parts are known; else of the posterior mean, where it holds points, with a
      deviation that allows for what was not seen. None where there is none.
    - `imagined`: None for a view that was not chosen, or not taken.
    - `unmeasured`: patches of that surface that views looked at and did not measure.
    """

    surface: MeanSurface | None
    imagined: Imagined | None
    unmeasured: Sequence[Patch] = ()


class Sketches:
    """Those of an episode that is under way: give `add` to `simulate(each=...)`, and the whole to `write_report`.

    - `episode`: without its views, which come one by one.
    - `held`: sketches by the index of the view, from 0; none of views that were given or read from a folder.
    """

    def __init__(self, episode: Episode):
        self.episode, self.held = episode, dict[int, Sketch]()

    def add(self, step: Step) -> None:
        """The step to the next view."""
        self.episode = dataclasses.replace(self.episode, views=(*self.episode.views, step.view))
        if step.inputs is not None:
            index = len(self.episode.views) - 1
            self.held[index] = _sketch(self.episode, index, step.inputs)


def sketches_of(episode: Episode, held: Mapping[int, Sketch], imagine: bool) -> Iterator[Sketch]:
    """The sketch of the step that follows each view, that of the one after the last included, which was not taken.

    `held`: those that there are; `imagine`: whether the others show what was imagined.
    """
    for index, observations in enumerate(episode.observations(), start=1):
        if index in held:
            yield held[index]
            continue
        if episode.planner.acquisition.needs_hypotheses:
            yield _sketch(episode, index, StepInputs(observations), imagine)
            continue
        posterior = episode.planner.sampler.posterior(observations)
        inputs = StepInputs(observations, posterior)
        # With the key of the step: what it imagined, and moments where the posterior has no closed ones.
        if (imagine and index < len(episode.views)) or not posterior.has_closed_forms:
            sample_key, *_ = view_keys(episode.key, index)
            surfaces = episode.planner.sampler.sample(observations, sample_key, posterior)
            inputs = dataclasses.replace(inputs, surfaces=surfaces)
        yield _sketch(episode, index, inputs, imagine)


def _sketch(episode: Episode, index: int, inputs: StepInputs, imagine: bool = True) -> Sketch:
    sampler, observations = episode.planner.sampler, inputs.observations
    surface: MeanSurface | None
    if isinstance(observations.hypotheses, PartHypotheses):
        surface = likeliest_part(observations.hypotheses)
    else:
        surface = as_shown(mean_surface(sampler, inputs), observations.cloud)
    patches = [] if surface is None else unmeasured(surface.mesh, observations, sampler.carving)
    seen = None
    if imagine and index < len(episode.views):
        seen = imagined(episode, index, inputs)
    return Sketch(surface, seen, patches)
