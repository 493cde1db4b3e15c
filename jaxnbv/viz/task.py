"""The task section of an episode's report: question, answers after each view, their reliability, and charts."""

import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float

from jaxnbv.acquisition import ImaginedView, inputs_of
from jaxnbv.checks import AnyArray
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.observations import Observations
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import View, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.stopping import Sure
from jaxnbv.programs import program
from jaxnbv.scanning import Surface, TriangleMesh, pixel_area
from jaxnbv.scanning.metrics import GRAZING, coverage, true_mesh
from jaxnbv.tasks.coverage import NewSurface, new_surface_of
from jaxnbv.utility import Answer
from jaxnbv.viz.answers import Chart, CoverageAnswer, capital, words_of


class Comparison(NamedTuple):
    """An episode with a different search from the same first view, for comparison in a `TaskReport`.

    - `name`, `sentence`: see `search_name` and `rival_text`.
    - `charts`, `coverage_chart`: as in `TaskReport`, for this episode.
    """

    name: str
    sentence: str
    charts: tuple[Chart, ...]
    coverage_chart: Chart


class TaskReport(NamedTuple):
    """The task of an episode, with its answers after each view.

    - `amounts`, `coverage_chart`: amount of surface seen after each view, and its chart.
    - `answers`, `charts`: answers after each view, and their charts. If the acquisition has no answers, they are the
      amounts and their chart.
    - `rival`: the comparison with a baseline, if one was run.
    - `choice_text`, `reliability_text`: how views were chosen, and from which view on the answer is reliable.
    """

    amounts: Sequence[CoverageAnswer]
    coverage_chart: Chart
    answers: Sequence[Answer]
    charts: tuple[Chart, ...]
    question: str
    choice_text: str
    answer_text: str
    reliability_text: str
    rival: Comparison | None

    @property
    def is_coverage(self) -> bool:
        """Whether the only question is how much of the surface was seen."""
        return self.answers is self.amounts


def task_of(
    episode: Episode,
    truth: Float[AnyArray, "n 3"] | None = None,
    rival: Episode | None = None,
    all_observations: Sequence[Observations] | None = None,
    true_surface: TriangleMesh | None = None,
) -> TaskReport:
    """Return the report of an episode's task. If the acquisition has no answers, the task is coverage.

    - `truth`: points of the true surface, in scene coordinates.
    - `rival`: an episode of a different search from the same first view.
    - `all_observations`, `true_surface`: observations after each view, and `true_mesh` of the scene, if already known.
    """
    planner = episode.planner
    amounts, true_answer = coverage_answers(episode, truth, all_observations), None
    answers = _answers(episode, episode.views) or amounts
    if episode.scene is not None and answers is not amounts:
        cloud = true_cloud(true_surface or episode.scene, planner.capacity)
        true_answer = None if cloud is None else planner.acquisition.true_answer(episode.scene, cloud)
    comparison = None
    if rival is not None:
        rival_amounts = coverage_answers(rival, truth)
        charts = _charts(_answers(episode, rival.views) or rival_amounts, true_answer)
        comparison = Comparison(search_name(rival), rival_text(rival, episode), charts, _charts(rival_amounts, None)[0])
    return TaskReport(
        amounts=amounts,
        coverage_chart=_charts(amounts, None)[0],
        answers=answers,
        charts=_charts(answers, true_answer),
        question=words_of(answers[-1]).question,
        choice_text=_choice_text(planner),
        answer_text=capital(words_of(answers[-1]).found)
        + ("" if true_answer is None else f". In truth: {words_of(true_answer).found}"),
        reliability_text=_reliability_text(episode, answers),
        rival=comparison,
    )


def _charts(answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
    return words_of(answers[-1]).charts(answers, truth)


def _answers(episode: Episode, views: Sequence[View]) -> Sequence[Answer]:
    """Return the acquisition's answers after these views, in world coordinates; empty if it has none."""
    answers = [view.answer(episode.planner.acquisition) for view in views]
    world_answers = [answer.in_world(episode.frame) for answer in answers if answer is not None]
    return world_answers if len(world_answers) == len(answers) else []


def coverage_answers(
    episode: Episode, truth: Float[AnyArray, "n 3"] | None, all_observations: Sequence[Observations] | None = None
) -> list[CoverageAnswer]:
    """Return how much of the surface was seen after each view.

    Given points of the true surface (`truth`), this is the percentage of these points that was seen. Otherwise it is
    the total new area in the scans, in squared world units. New area is computed as in the planner's acquisition if
    that is a `NewSurface`, else as in `NewSurface()`. But the cosine of incidence is clipped to at least 0.2, not 0.5.
    """
    views, acquisition = episode.views, episode.planner.acquisition
    if truth is not None:
        percentages = [100.0 * float(percentage) for percentage in coverage(views, truth)]
        return [CoverageAnswer(("of the surface seen",), np.array([percentage])) for percentage in percentages]
    new_surface = new_surface_of(acquisition)
    before = itertools.chain([None], episode.observations() if all_observations is None else all_observations)
    new = [
        float(_new_area(new_surface, observations, ImaginedView(view.scan, view.camera, view.pose)))
        for observations, view in zip(before, views, strict=False)
    ]
    areas, unit = episode.frame.length_to_world(np.cumsum(new), 2), f"{episode.frame.unit}²"
    return [CoverageAnswer(("of surface seen",), np.array([area]), unit=unit) for area in areas]


@program
def _new_area(new_surface: NewSurface, before: Observations | None, view: ImaginedView) -> Float[Array, ""]:
    area = pixel_area(view.scan, view.camera, view.pose, GRAZING)
    return jnp.sum(area if before is None else area * new_surface.context(inputs_of(before))(view.scan.points))


def true_cloud(scene: Surface, count: int) -> PointCloud | None:
    """Sample `count` points with normals, uniformly by area, from a known surface. None if it has no mesh."""
    mesh = true_mesh(scene)
    if mesh is None:
        return None
    triangles = mesh.to_trimesh()
    points, faces = trimesh.sample.sample_surface(triangles, count, seed=0)
    return PointCloud.from_arrays(np.asarray(points, np.float32), np.asarray(triangles.face_normals[faces], np.float32))


def is_reliable_after(episode: Episode, answers: Sequence[Answer]) -> list[bool]:
    """Return, for each view, whether its answer is reliable.

    For class probabilities the stop rule `Sure` decides, with the random keys of the episode.
    """

    def holds(rule: Sure, index: int) -> bool:
        key, *_ = view_keys(episode.key, index + 1)
        return rule.reason(episode.planner.acquisition, episode.views[index].cloud, key) is not None

    return words_of(answers[-1]).settled(answers, holds)


def first_reliable(is_reliable: Sequence[bool]) -> int | None:
    """Return the view (from 1) from which on all answers are reliable; None if the last answer is not."""
    return len(is_reliable) - int(np.argmin([*is_reliable[::-1], False]) - 1) if is_reliable[-1] else None


def first_lost(is_reliable: Sequence[bool]) -> int | None:
    """Return the first view (from 1) with a reliable answer if a later one is not reliable; else None."""
    index = int(np.argmax(is_reliable))
    return index + 1 if is_reliable[index] and not all(is_reliable[index:]) else None


def search_name(episode: Episode) -> str:
    """Return the kind of an episode's search in words: "farthest view" for `FarthestView`."""
    return re.sub("(?<!^)(?=[A-Z])", " ", type(episode.planner.search).__name__).lower()


def rival_text(rival: Episode, episode: Episode) -> str:
    """Return a sentence about a different search: number of views, whether a stop rule held, and answer."""
    name, count = search_name(rival).capitalize(), len(rival.views)
    answers = _answers(episode, rival.views[-1:])
    views = f"{count} view{'s' * (count > 1)}"
    text = f"{name} {'needed' if rival.stop_reason else 'took'} {views} from the same start"
    if episode.stop_reason and not rival.stop_reason:
        text = f"{name} was not done after {views} from the same start"
    return f"{text} ({words_of(answers[-1]).found})." if answers else f"{text}."


def _choice_text(planner: Planner) -> str:
    name = planner.quantity.name
    if not planner.search.uses_samples:
        return f"Each view is where the {name} is highest."
    if planner.acquisition.needs_hypotheses:
        return f"Each view is where the {name} is highest, over the likeliest parts and how they may lie."
    return f"Each view is where the {name} is highest, over {planner.sampler.num_samples} imagined surfaces."


def _reliability_text(episode: Episode, answers: Sequence[Answer]) -> str:
    is_reliable, count = is_reliable_after(episode, answers), len(answers)
    first, lost = first_reliable(is_reliable), first_lost(is_reliable)
    text = f"From view {first} on" if first else f"Not yet after {count} view{'s' * (count > 1)}"
    lost_text = f" At view {lost} it was sure already, but then not." if lost else ""
    stop_text = "" if episode.stop_reason is None else f" It stopped: {episode.stop_reason}."
    return f"{text}.{lost_text} Sure means {words_of(answers[-1]).settled_means}.{stop_text}"
