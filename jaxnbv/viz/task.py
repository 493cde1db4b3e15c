"""The task of an episode for its report: question, answers by view, their reliability, and charts."""

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
from jaxnbv.scanning import Surface, pixel_area
from jaxnbv.scanning.metrics import GRAZING, coverage, true_mesh
from jaxnbv.tasks.coverage import NewSurface, new_surface_of
from jaxnbv.utility import Answer
from jaxnbv.viz.answers import Chart, CoverageAnswer, capital, words_of


class Rival(NamedTuple):
    """Result of a different search from the same first view: name, a sentence, and charts as in `Task`."""

    name: str
    words: str
    charts: tuple[Chart, ...]
    seen: Chart


class Task(NamedTuple):
    """The task of an episode, with its answers after each view.

    - `amounts`, `seen`: amount of surface seen after each view, and its chart.
    - `answers`, `charts`: answers after each view, and their charts. If the acquisition has no answers, these are the
      amounts.
    - `question`, `asked`, `found`, `sure`: texts for the head of the report: the question, how views were chosen, the
      answer, and from which view on the answer is reliable.
    - `rival`: result of a different search, or None.
    """

    amounts: Sequence[CoverageAnswer]
    seen: Chart
    answers: Sequence[Answer]
    charts: tuple[Chart, ...]
    question: str
    asked: str
    found: str
    sure: str
    rival: Rival | None

    @property
    def is_coverage(self) -> bool:
        """Whether the only question is how much of the surface was seen."""
        return self.answers is self.amounts


def task_of(
    episode: Episode,
    truth: Float[AnyArray, "n 3"] | None = None,
    rival: Episode | None = None,
    replayed: Sequence[Observations] | None = None,
) -> Task:
    """Return the task of an episode: that of its acquisition, or to see all surface if it has no answers.

    - `truth`: points of the true surface, in scene coordinates.
    - `rival`: an episode of a different search from the same first view.
    - `replayed`: observations after each view, if they are already computed.
    """
    planner = episode.planner
    seen, true = seen_after(episode, truth, replayed), None
    answers = _answers(episode, episode.views) or seen
    if episode.scene is not None and answers is not seen:
        cloud = true_cloud(episode.scene, planner.capacity)
        true = None if cloud is None else planner.acquisition.true_answer(episode.scene, cloud)
    beside = None
    if rival is not None:
        rival_seen = seen_after(rival, truth)
        charts = _charts(_answers(episode, rival.views) or rival_seen, true)
        beside = Rival(search_name(rival), race_words(rival, episode), charts, _charts(rival_seen, None)[0])
    return Task(
        amounts=seen,
        seen=_charts(seen, None)[0],
        answers=answers,
        charts=_charts(answers, true),
        question=words_of(answers[-1]).question,
        asked=_asked(planner),
        found=capital(words_of(answers[-1]).found) + ("" if true is None else f". In truth: {words_of(true).found}"),
        sure=_sure(episode, answers),
        rival=beside,
    )


def _charts(answers: Sequence[Answer], truth: Answer | None) -> tuple[Chart, ...]:
    return words_of(answers[-1]).charts(answers, truth)


def _answers(episode: Episode, views: Sequence[View]) -> Sequence[Answer]:
    """Return the acquisition's answers after these views, in world coordinates; empty if it has none."""
    answers = [view.answer(episode.planner.acquisition) for view in views]
    said = [answer.in_world(episode.frame) for answer in answers if answer is not None]
    return said if len(said) == len(answers) else []


def seen_after(
    episode: Episode, truth: Float[AnyArray, "n 3"] | None, replayed: Sequence[Observations] | None = None
) -> list[CoverageAnswer]:
    """Return how much of the surface was seen after each view.

    Given the true surface, this is the percentage of it that was seen. Otherwise it is the sum of the new areas that
    scans show, in squared world units. `NewSurface` defines what is new, with the acquisition's settings if it is a
    `NewSurface`. An area measured at a slant counts in full here, but for less in the acquisition.

    - `truth`: points of the true surface, in scene coordinates.
    - `replayed`: observations after each view, if they are already computed.
    """
    views, acquisition = episode.views, episode.planner.acquisition
    if truth is not None:
        shares = [100.0 * float(share) for share in coverage(views, truth)]
        return [CoverageAnswer(("of the surface seen",), np.array([share])) for share in shares]
    of = new_surface_of(acquisition)
    before = itertools.chain([None], episode.observations() if replayed is None else replayed)
    new = [
        float(_new_area(of, seen, ImaginedView(view.scan, view.camera, view.pose)))
        for seen, view in zip(before, views, strict=False)
    ]
    areas, unit = episode.frame.length_to_world(np.cumsum(new), 2), f"{episode.frame.unit}²"
    return [CoverageAnswer(("of surface seen",), np.array([area]), unit=unit) for area in areas]


@program
def _new_area(of: NewSurface, before: Observations | None, view: ImaginedView) -> Float[Array, ""]:
    area = pixel_area(view.scan, view.camera, view.pose, GRAZING)
    return jnp.sum(area if before is None else area * of.context(inputs_of(before))(view.scan.points))


def true_cloud(scene: Surface, count: int) -> PointCloud | None:
    """Sample `count` points with normals, uniform by area, from a known surface; None if it has no mesh."""
    mesh = true_mesh(scene)
    if mesh is None:
        return None
    own = mesh.to_trimesh()
    points, faces = trimesh.sample.sample_surface(own, count, seed=0)
    return PointCloud.from_arrays(np.asarray(points, np.float32), np.asarray(own.face_normals[faces], np.float32))


def settled_after(episode: Episode, answers: Sequence[Answer]) -> list[bool]:
    """Return, for each view, whether its answer is reliable. Stop rules get the episode's random keys."""

    def holds(rule: Sure, index: int) -> bool:
        key, *_ = view_keys(episode.key, index + 1)
        return rule.reason(episode.planner.acquisition, episode.views[index].cloud, key) is not None

    return words_of(answers[-1]).settled(answers, holds)


def since(settled: Sequence[bool]) -> int | None:
    """Return the first view (from 1) from which on all answers are reliable; None if the last one is not."""
    return len(settled) - int(np.argmin([*settled[::-1], False]) - 1) if settled[-1] else None


def lost_again(settled: Sequence[bool]) -> int | None:
    """Return the first view (from 1) with a reliable answer if a later one is unreliable; None otherwise."""
    first = int(np.argmax(settled))
    return first + 1 if settled[first] and not all(settled[first:]) else None


def search_name(episode: Episode) -> str:
    """Return the kind of an episode's search in words: "farthest view" for `FarthestView`."""
    return re.sub("(?<!^)(?=[A-Z])", " ", type(episode.planner.search).__name__).lower()


def race_words(rival: Episode, episode: Episode) -> str:
    """Return a sentence about a different search from the same first view: number of views, and answer.

    It says if these views did not fulfil the stop rule that ended `episode`.
    """
    name, count = search_name(rival).capitalize(), len(rival.views)
    answers = _answers(episode, rival.views)
    views = f"{count} view{'s' * (count > 1)}"
    text = f"{name} {'needed' if rival.stop_reason else 'took'} {views} from the same start"
    if episode.stop_reason and not rival.stop_reason:
        text = f"{name} was not done after {views} from the same start"
    return f"{text} ({words_of(answers[-1]).found})." if answers else f"{text}."


def _asked(planner: Planner) -> str:
    name = planner.quantity.name
    if not planner.search.uses_samples:
        return f"Each view is where the {name} is highest."
    if planner.acquisition.needs_hypotheses:
        return f"Each view is where the {name} is highest, over the likeliest parts and how they may lie."
    return f"Each view is where the {name} is highest, over {planner.sampler.num_samples} imagined surfaces."


def _sure(episode: Episode, answers: Sequence[Answer]) -> str:
    settled, count = settled_after(episode, answers), len(answers)
    first, lost = since(settled), lost_again(settled)
    text = f"From view {first} on" if first else f"Not yet after {count} view{'s' * (count > 1)}"
    again = f" At view {lost} it was sure already, but then not." if lost else ""
    ended = "" if episode.stop_reason is None else f" It ended by its rule: {episode.stop_reason}."
    return f"{text}.{again} Sure means {words_of(answers[-1]).settled_means}.{ended}"
