"""The task by view: what was asked, what was found, when it was sure, and the numbers for its charts."""

import equinox as eqx
import numpy as np
import trimesh

from jaxnbv.acquisition import Answer
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Surface
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.viz.answers import CoverageAnswer, Panel, words_of


class Task(eqx.Module):
    """What the views were for.

    - `answers`: after each view; `truth`: what they should come to, None where that is not known.
    - `panels`: view by view the charts of the answer.
    - `asked`, `found`, `sure`: how it was asked, what was found and since when, for the head of the report; `race`: how
      another search fared, "" without one.
    """

    answers: tuple[Answer, ...]
    truth: Answer | None
    panels: tuple[tuple[Panel, ...], ...]
    asked: str
    found: str
    sure: str
    race: str

    @property
    def question(self) -> str:
        """What was asked."""
        return words_of(self.answers[-1]).question

    @property
    def is_coverage(self) -> bool:
        """Whether its answer is how much was seen."""
        return isinstance(self.answers[-1], CoverageAnswer)


def task_of(episode: Episode, covered: list[float | None], rival: Episode | None = None) -> Task:
    """The task of an episode's acquisition; that of seeing all of the surface, where it answers nothing.

    - `covered`: the share of the true surface that was seen after each view; None where not known.
    - `rival`: an episode of another search from the same first view.
    """
    acquisition = episode.planner.acquisition
    given = [acquisition.answer(view.cloud) for view in episode.views]
    answers = [answer for answer in given if answer is not None]
    truth = None
    if len(answers) == len(given) and episode.scene is not None:
        cloud = true_cloud(episode.scene, episode.planner.capacity)
        truth = None if cloud is None else acquisition.true_answer(episode.scene, cloud)
    if len(answers) < len(given):
        answers = [_coverage(int(view.cloud.count), share) for view, share in zip(episode.views, covered, strict=True)]
    panels = tuple(words_of(answer).panels(truth) for answer in answers)
    head = _asked(episode.planner), _found(answers, truth), _sure(answers, episode)
    return Task(tuple(answers), truth, panels, *head, "" if rival is None else race_words(rival))


def true_cloud(scene: Surface, count: int) -> PointCloud | None:
    """Points all over a known surface with their normals, uniform by area; None for a kind that cannot be sampled."""
    mesh = true_mesh(scene)
    if mesh is None:
        return None
    own = mesh.to_trimesh()
    points, faces = trimesh.sample.sample_surface(own, count, seed=0)
    return PointCloud.from_arrays(np.asarray(points, np.float32), np.asarray(own.face_normals[faces], np.float32))


def since(answers: list[Answer]) -> int | None:
    """The first view (from 1) from which on all answers can be relied on; None if not even the last can."""
    befores = [None, *answers[:-1]]
    relied = [words_of(answer).settled(before) for answer, before in zip(answers, befores, strict=True)]
    return None if not relied[-1] else len(relied) - int(np.argmin([*relied[::-1], False]) - 1)


def race_words(rival: Episode) -> str:
    """How many views another search needed, from the same first view, until the same rule held."""
    search, count = type(rival.planner.search).__name__, len(rival.views)
    answer = rival.planner.acquisition.answer(rival.views[-1].cloud)
    found = "" if answer is None else f" ({words_of(answer).found})"
    needed = f"needed {count} views" if rival.stopped else f"did not find it in {count} views"
    return f"{search} {needed} from the same start{found}."


def _coverage(count: int, share: float | None) -> CoverageAnswer:
    if share is None:
        return CoverageAnswer(("points kept",), np.array([float(count)]), "{:,.0f}")
    return CoverageAnswer(("of the surface seen",), np.array([share]))


def _asked(planner: Planner) -> str:
    samples = f" over {planner.imagination.num_samples} imagined surfaces a step" if planner.search.uses_samples else ""
    return f"Each view is where the {planner.quantity.name} is highest, by {type(planner.search).__name__}{samples}."


def _found(answers: list[Answer], truth: Answer | None) -> str:
    last = words_of(answers[-1]).found
    text = f"{last[:1].upper()}{last[1:]}"
    return text if truth is None else f"{text}. In truth: {words_of(truth).found}"


def _sure(answers: list[Answer], episode: Episode) -> str:
    first, count = since(answers), len(answers)
    text = f"From view {first} on" if first else f"Not yet after {count} view{'s' * (count > 1)}"
    text = f"{text}; sure means {words_of(answers[-1]).settled_means}."
    return f"{text} Ended: {episode.stopped}." if episode.stopped else text
