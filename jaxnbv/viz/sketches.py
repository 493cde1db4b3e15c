"""Sketches: the costly parts of an episode's pictures, made while a step's samples are in memory."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

from jaxnbv.observations import Observations
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import Step, view_keys
from jaxnbv.sampler import StepInputs
from jaxnbv.utility import Answer
from jaxnbv.viz.imagined import Imagined, render_imagined
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.shown_surface import needs_no_posterior, shown_surface
from jaxnbv.viz.unmeasured import Patch, unmeasured


class Sketch(NamedTuple):
    """Costly parts of the pictures of one step, before its view is taken.

    - `surface`, `unmeasured`: see the functions `shown_surface` and `unmeasured`.
    - `imagined`: see `render_imagined`. None also for a step whose view was not taken.
    """

    surface: MeanSurface | None
    imagined: Imagined | None
    unmeasured: Sequence[Patch] = ()


class Sketches:
    """Sketches of a running episode.

    Pass its method `add` to `simulate(each=...)`, and the `Sketches` itself to `write_report`.

    - `episode`: the episode so far, at first without views.
    - `held`: sketches keyed by the index of the view, from 0. The first view and views from a file have no sketch.
    """

    def __init__(self, episode: Episode):
        self.episode, self.held = episode, dict[int, Sketch]()

    def add(self, step: Step) -> None:
        """Add the view of a step to `episode`, and its sketch to `held`."""
        self.episode = dataclasses.replace(self.episode, views=(*self.episode.views, step.view))
        if step.inputs is not None:
            planner, index = self.episode.planner, len(self.episode.views) - 1
            # An answer can take seconds, and only known shapes use it.
            is_used = needs_no_posterior(planner.sampler)
            answer = self.episode.views[index - 1].answer(planner.acquisition) if is_used else None
            self.held[index] = _sketch(self.episode, index, step.inputs, answer)


def sketches_of(
    episode: Episode,
    all_observations: Iterable[Observations],
    answers: Iterable[Answer],
    by_view: Mapping[int, Sketch],
    imagine: bool,
) -> Iterator[Sketch]:
    """Yield the sketch of the step after each view, including the step after the last view.

    - `all_observations`, `answers`: observations and answer after each view.
    - `by_view`: sketches that exist already, keyed by the index of the step's view.
    - `imagine`: whether new sketches have `imagined` and `unmeasured`, not only `surface`.
    """
    planner, sampler = episode.planner, episode.planner.sampler
    for index, (observations, answer) in enumerate(zip(all_observations, answers, strict=True), start=1):
        if index in by_view:
            yield by_view[index]
            continue
        inputs, is_imagined = StepInputs(observations), imagine and index < len(episode.views)
        if not planner.acquisition.needs_hypotheses and (is_imagined or not needs_no_posterior(sampler)):
            posterior, surfaces = sampler.posterior(observations), None
            # The step's own key gives the samples that it imagined. A posterior without closed forms needs samples too.
            if is_imagined or not posterior.has_closed_forms:
                sample_key, *_ = view_keys(episode.key, index)
                surfaces = sampler.sample(observations, sample_key, posterior)
            inputs = StepInputs(observations, posterior, surfaces)
        yield _sketch(episode, index, inputs, answer, imagine)


def _sketch(episode: Episode, index: int, inputs: StepInputs, answer: Answer | None, imagine: bool = True) -> Sketch:
    sampler = episode.planner.sampler
    surface = shown_surface(sampler, inputs, answer)
    if not imagine:
        return Sketch(surface, None)
    patches = [] if surface is None else unmeasured(surface.mesh, inputs.observations, sampler.carving)
    return Sketch(surface, render_imagined(episode, index, inputs) if index < len(episode.views) else None, patches)
