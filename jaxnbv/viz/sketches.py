"""Sketches: the costly parts of an episode's pictures, drawn after each step while its samples are in memory."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from jaxnbv.observations import Observations
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import Step, view_keys
from jaxnbv.sampler import StepInputs
from jaxnbv.viz.imagined import Imagined, imagined
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.shown_surface import has_bank, shown_surface
from jaxnbv.viz.unmeasured import Patch, unmeasured


class Sketch(NamedTuple):
    """The state of a step before its view was taken.

    - `surface`: the surface that pictures show, see `shown_surface`.
    - `imagined`: samples of the step; None for a view that was not chosen, or not taken.
    - `unmeasured`: patches of the surface that views looked at and did not measure.
    """

    surface: MeanSurface | None
    imagined: Imagined | None
    unmeasured: Sequence[Patch] = ()


class Sketches:
    """Sketches of a running episode: `add` is for `simulate(each=...)`, the object for `write_report`.

    - `episode`: the episode without views.
    - `held`: sketches by the index of the view, from 0. First and stored views have none.
    """

    def __init__(self, episode: Episode):
        self.episode, self.held = episode, dict[int, Sketch]()

    def add(self, step: Step) -> None:
        """Add the step to the next view."""
        self.episode = dataclasses.replace(self.episode, views=(*self.episode.views, step.view))
        if step.inputs is not None:
            index = len(self.episode.views) - 1
            self.held[index] = _sketch(self.episode, index, step.inputs)


def sketches_of(
    episode: Episode, replayed: Iterable[Observations], held: Mapping[int, Sketch], imagine: bool
) -> Iterator[Sketch]:
    """The sketch of the step after each view, including the one after the last view.

    - `replayed`: observations after each view.
    - `held`: sketches that exist already.
    - `imagine`: whether the others show what was imagined.
    """
    for index, observations in enumerate(replayed, start=1):
        if index in held:
            yield held[index]
            continue
        if episode.planner.acquisition.needs_hypotheses:
            yield _sketch(episode, index, StepInputs(observations), imagine)
            continue
        sampler, is_imagined = episode.planner.sampler, imagine and index < len(episode.views)
        if has_bank(sampler) and not is_imagined:
            yield _sketch(episode, index, StepInputs(observations), imagine)
            continue
        posterior = sampler.posterior(observations)
        inputs = StepInputs(observations, posterior)
        # The step's own key gives the samples that it imagined, and moments without a closed form.
        if is_imagined or not posterior.has_closed_forms:
            sample_key, *_ = view_keys(episode.key, index)
            surfaces = sampler.sample(observations, sample_key, posterior)
            inputs = dataclasses.replace(inputs, surfaces=surfaces)
        yield _sketch(episode, index, inputs, imagine)


def _sketch(episode: Episode, index: int, inputs: StepInputs, imagine: bool = True) -> Sketch:
    sampler, observations = episode.planner.sampler, inputs.observations
    surface = shown_surface(sampler, inputs)
    patches = [] if surface is None else unmeasured(surface.mesh, observations, sampler.carving)
    samples = imagined(episode, index, inputs) if imagine and index < len(episode.views) else None
    return Sketch(surface, samples, patches)
