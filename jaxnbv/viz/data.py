"""What the pictures of an episode show, as plain arrays: computed once a view, drawn by `report` and `figures`."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxnbv.acquisition import Quantity
from jaxnbv.checks import AnyArray
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode import Episode
from jaxnbv.progress import progress_bar
from jaxnbv.scanning.metrics import truth_points
from jaxnbv.viz.answers import CoverageAnswer, words_of
from jaxnbv.viz.choice import Ascents, Choice, choice_of
from jaxnbv.viz.imagined import Imagined, Look, taken_look
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.sketches import Sketch, Sketches, sketches_of
from jaxnbv.viz.stage import Stage, stage_of
from jaxnbv.viz.task import Task, seen_after, task_of
from jaxnbv.viz.words import Told, describe_choice, describe_first


class ViewData(eqx.Module):
    """One view, ready to be drawn.

    - `number`: from 1.
    - `before`: points kept before this view; `new`: points it added. Scene coordinates.
    - `surface`: of the posterior mean, where it holds points, with a deviation that allows for what was not seen; None
      where it has none within the grid.
    - `choice`: None for a view that was given.
    - `seen`: how much of the surface was seen.
    - `told`: what happened, in words.
    - `imagined`: what was imagined before it was taken; None for a view that was given.
    - `look`: the scan itself; None where it is no image.
    - `guesses`: pieces of the mean's surface that hold no points, if there are some.
    """

    number: int
    pose: Pose
    before: Float[np.ndarray, "n 3"]
    new: Float[np.ndarray, "m 3"]
    surface: MeanSurface | None
    choice: Choice | None
    seen: CoverageAnswer
    told: Told
    imagined: Imagined | None = None
    look: Look | None = None
    guesses: MeanSurface | None = None

    @property
    def sentence(self) -> str:
        """What happened, in words."""
        return self.told.sentence(self.number)

    @property
    def spatial_ascents(self) -> Ascents | None:
        """The trajectories that led to this view, where they left the sphere."""
        ascents = None if self.choice is None else self.choice.ascents
        return None if ascents is None or not ascents.is_spatial else ascents


class ReportData(eqx.Module):
    """All views of an episode, what the values of its search mean, what the views were for, whence they are drawn.

    - `frame`: to the world that the object's file was given in; None where there was none.
    """

    views: tuple[ViewData, ...]
    quantity: Quantity
    task: Task
    stage: Stage
    frame: Frame | None


def report_data(
    episode: Episode,
    truth: Float[AnyArray, "n 3"] | None = None,
    progress: bool = True,
    imagine: bool = True,
    rival: Episode | None = None,
    sketches: Sketches | None = None,
) -> ReportData:
    """Everything that the pictures of an episode show.

    - `truth`: points of the true surface (scene coordinates); by default sampled from the scene, where it can be.
    - `imagine`: whether what the steps imagined is shown.
    - `rival`: an episode of another search from the same first view.
    - `sketches`: what was drawn while the episode was under way. For a step that is not among them the model is
      conditioned and sampled again.
    """
    planner = episode.planner
    if truth is None and episode.scene is not None:
        truth = truth_points(episode.scene, jax.random.key(0))
    seen = seen_after(episode.views, truth, planner.acquisition)
    rival_seen = () if rival is None else seen_after(rival.views, truth, planner.acquisition)
    task = task_of(episode, seen, rival, rival_seen)
    drawn: list[ViewData] = []
    held = {} if sketches is None else sketches.held
    following = zip(episode.views, sketches_of(episode, held, imagine), strict=True)
    leading: Sketch | None = None
    bar = progress_bar(following, progress, desc="drawing views", total=len(episode.views))
    for index, (view, next_one) in enumerate(bar):
        new, _ = view.scan.to_numpy()
        before = episode.views[index - 1].cloud.to_numpy()[0] if index else np.zeros((0, 3), new.dtype)
        choice = None if view.proposal is None else choice_of(view.proposal)
        drawn.append(
            ViewData(
                number=index + 1,
                pose=view.pose,
                before=before,
                new=new,
                surface=next_one.surface,
                choice=choice,
                seen=seen[index],
                told=_told(episode, index, choice, task, seen),
                imagined=None if leading is None else leading.imagined,
                look=taken_look(view, before),
                guesses=next_one.guesses,
            )
        )
        leading = next_one
    means = [view.surface.mesh for view in drawn if view.surface is not None]
    frame = getattr(episode.scene, "frame", None)
    return ReportData(tuple(drawn), planner.quantity, task, stage_of(episode, means), frame)


def _told(episode: Episode, index: int, choice: Choice | None, task: Task, seen: list[CoverageAnswer]) -> Told:
    view = episode.views[index]
    points = int(view.scan.count)
    if choice is None or not index:
        told = describe_first(view.pose, points, seen[index])
    else:
        earlier = [other.pose for other in episode.views[:index]]
        came = points, int(view.cloud.count), (seen[index - 1], seen[index])
        told = describe_choice(episode.planner.quantity, choice, view.pose, earlier, *came)
    if not task.is_coverage:
        answer = words_of(task.answers[index]).sentence(task.answers[index - 1] if index else None)
        told = told._replace(came=f"{told.came} {answer}")
    return told
