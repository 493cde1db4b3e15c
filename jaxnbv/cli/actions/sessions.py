"""What `jaxnbv session replay DIR` does."""

from types import SimpleNamespace

import numpy as np
import typer

from jaxnbv import viz
from jaxnbv.cli.actions.device import prepare
from jaxnbv.cli.actions.episodes import QUICK, USUAL, knowing, planner_of, task_for
from jaxnbv.cli.actions.sensors import with_rays
from jaxnbv.cli.actions.tasks import Given, position
from jaxnbv.imagination import Imagination
from jaxnbv.planning.replay import StoredSession
from jaxnbv.viz.answers import words_of


def replay(asked: SimpleNamespace) -> None:
    """Where another task would have looked next, after each image of a session.

    **Raises:** `ValueError` for a task without what it needs, or with what it has no use for.
    """
    prepare(asked.device)
    stored, source = StoredSession(asked.folder), asked.source
    if source is not None:
        place = stored.frame.to_scene(np.array(position("--source", source)))
        source = ",".join(str(float(x)) for x in place)
    options = {"network": asked.network, "category": asked.category, "source": source}
    made, (first, seen) = task_for(asked.task, **options), stored.first_view()
    given = Given(first, lambda: seen.to_numpy()[0], lambda: seen.to_numpy()[0], **options)
    setting = with_rays(made.setting, asked.quick)
    imagination = knowing(Imagination.preset(asked.model, quick=asked.quick), asked.known)
    planner = planner_of(setting, made.acquisition(given), asked.search, imagination, QUICK if asked.quick else USUAL)
    out = asked.out or asked.folder.with_name(f"{asked.folder.name}-{asked.task}-{asked.search}")
    sought = planner.quantity
    replayed = None
    for replayed, proposed in stored.replay(planner, out):
        points = int(replayed.evidence.cloud.count)
        typer.echo(
            f"image {replayed.views}   {points:5d} points kept; next from {_place(proposed.matrix)}, "
            f"{sought.name} {proposed.value:.4g}{_taken(stored, replayed.views, proposed.matrix)}"
        )
        answer = planner.acquisition.answer(replayed.evidence.cloud)
        if answer is not None:
            typer.echo(f"          {words_of(answer).line()}")
    if asked.report and replayed is not None:
        typer.echo(f"report    {viz.write_report(replayed.episode, out, title=asked.folder.name)}")
    typer.echo(f"session   {out}")


def _taken(stored: StoredSession, index: int, proposed: np.ndarray) -> str:
    """Where the next image was taken truly, and how far from there."""
    if index >= stored.views:
        return ""
    taken = np.asarray(stored.image(index).matrix)
    away = float(np.linalg.norm(taken[:3, 3] - proposed[:3, 3]))
    return f"; taken from {_place(taken)}, {away:.3g} away"


def _place(matrix: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:+.3f}" for x in matrix[:3, 3]) + ")"
