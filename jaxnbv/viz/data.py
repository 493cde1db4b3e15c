"""Data that the pictures of an episode show, computed once per view for `report` and `figures`."""

import dataclasses
import itertools

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import View
from jaxnbv.progress import progress_bar
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import true_mesh, truth_points
from jaxnbv.search import Proposal
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.utility import Quantity
from jaxnbv.viz.answers import CoverageAnswer, capital, words_of
from jaxnbv.viz.imagined import Imagined, ShadedImage, view_image
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.placed_shape import PlacedShape
from jaxnbv.viz.sketches import Sketch, Sketches, sketches_of
from jaxnbv.viz.style import middle_range
from jaxnbv.viz.task import TaskReport, task_of
from jaxnbv.viz.unmeasured import unmeasured_text
from jaxnbv.viz.viewpoint import Viewpoint, viewpoint_of
from jaxnbv.viz.words import sentences_about


class ViewData(eqx.Module):
    """One view, ready to be drawn.

    - `view`: the view, with the values of its proposal in world units.
    - `before`, `new`: points of the cloud before the view, and points of the view's scan, in scene coordinates.
    - `surface`: see `shown_surface`, but its deviation is in world units. `has_shape`: whether it is a known shape.
    - `coverage`: amount of surface seen after the view.
    - `sentences`, `imagined`, `image`: see `sentences_about`, `render_imagined` and `view_image`.
    """

    view: View
    before: Float[np.ndarray, "n 3"]
    surface: MeanSurface | None
    coverage: CoverageAnswer
    sentences: dict[str, str]
    imagined: Imagined | None
    image: ShadedImage | None

    @property
    def has_shape(self) -> bool:
        return isinstance(self.surface, PlacedShape)

    @property
    def pose(self) -> Pose:
        return self.view.pose

    @property
    def proposal(self) -> Proposal | None:
        return self.view.proposal

    @property
    def new(self) -> Float[np.ndarray, "m 3"]:
        return self.view.scan.to_numpy()[0]


class ReportData(eqx.Module):
    """Everything that the pictures of an episode show."""

    episode: Episode
    views: tuple[ViewData, ...]
    quantity: Quantity
    task: TaskReport
    viewpoint: Viewpoint
    true_surface: TriangleMesh | None

    @property
    def proposals(self) -> list[Proposal]:
        """The proposals of the chosen views."""
        return [view.proposal for view in self.views if view.proposal is not None]

    @property
    def deviations(self) -> tuple[float, float]:
        """Range of the surfaces' standard deviations in world units, which the colours of all views share."""
        by_view = [view.surface.deviation for view in self.views if view.surface is not None and not view.has_shape]
        return middle_range(np.concatenate(by_view)) if by_view else (1e-3, 1.0)

    @property
    def has_deviations(self) -> bool:
        """Whether any surface is coloured by its standard deviation. Known shapes are not."""
        return any(view.surface is not None and not view.has_shape for view in self.views)

    @property
    def samples_surfaces(self) -> bool:
        """Whether the steps imagined samples of the posterior. Otherwise they imagined known parts."""
        return not isinstance(self.episode.views[0].hypotheses, PartHypotheses)

    @property
    def has_shapes(self) -> bool:
        """Whether any view shows a known shape."""
        return any(view.has_shape for view in self.views)


def report_data(
    episode: Episode,
    truth: Float[AnyArray, "n 3"] | None = None,
    progress: bool = True,
    imagine: bool = True,
    rival: Episode | None = None,
    sketches: Sketches | None = None,
) -> ReportData:
    """Compute everything that the pictures of an episode show.

    - `truth`, `rival`: see `write_report`.
    - `imagine`: whether to show the surfaces that the steps imagined, and surface that no view could measure.
    - `sketches`: sketches made while the episode ran. Missing sketches are made here.
    """
    planner, frame = episode.planner, episode.frame
    true_surface = None if episode.scene is None else true_mesh(episode.scene)
    if truth is None and true_surface is not None:
        truth = truth_points(true_surface, jax.random.key(0))
    all_observations = tuple(episode.observations())
    task = task_of(episode, truth, rival, all_observations, true_surface)
    by_view = {} if sketches is None else sketches.held
    next_sketches = sketches_of(episode, all_observations, task.answers, by_view, imagine)
    next_sketches = progress_bar(next_sketches, progress, desc="drawing views", total=len(episode.views))
    power, view_data = planner.quantity.length_power, list[ViewData]()
    views = [
        view if view.proposal is None else dataclasses.replace(view, proposal=view.proposal.in_world(frame, power))
        for view in episode.views
    ]
    sketch = Sketch(None, None)
    # The gain of a single view is comparable with its expected value only if `gains_once` holds.
    gains = episode.actual_scores(all_observations) if planner.acquisition.gains_once else itertools.repeat(None)
    for index, (next_sketch, gain) in enumerate(zip(next_sketches, gains, strict=False)):
        view, gain = views[index], None if gain is None else float(frame.length_to_world(gain, power))
        sentences = sentences_about(planner.quantity, views[: index + 1], task.amounts[: index + 1], frame, gain)
        if not task.is_coverage:
            answer_text = words_of(task.answers[index]).said(task.answers[index - 1] if index else None)
            sentences["Result"] += f" {capital(answer_text)}."
        before = episode.views[index - 1].cloud.to_numpy()[0] if index else np.zeros((0, 3), np.float32)
        if next_sketch.unmeasured:
            sentences["Never measured"] = unmeasured_text(next_sketch.unmeasured, frame)
        image = view_image(view, before)
        surface = next_sketch.surface
        if surface is not None:
            surface = dataclasses.replace(surface, deviation=frame.length_to_world(surface.deviation))
        view_data.append(ViewData(view, before, surface, task.amounts[index], sentences, sketch.imagined, image))
        sketch = next_sketch
    means = [view.surface.mesh for view in view_data if view.surface is not None]
    return ReportData(episode, tuple(view_data), planner.quantity, task, viewpoint_of(episode, means), true_surface)
