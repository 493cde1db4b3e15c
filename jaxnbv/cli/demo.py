"""`jaxnbv demo`: simulates an episode on a built-in object."""

from dataclasses import dataclass
from typing import Annotated

from jaxnbv.cli.episode import EpisodeOptions, SearchOption, SeedOption, TaskOption, by_task
from jaxnbv.cli.options import command, help_sentence, task_option
from jaxnbv.cli.tasks import TASKS


@dataclass(frozen=True, kw_only=True)
class DemoOptions(EpisodeOptions):
    task: TaskOption = "cross-entropy"
    search: SearchOption = "halving"
    seed: SeedOption = 2
    scene: Annotated[
        int, task_option(metavar="N", min=0, max=2**31 - 1, help="Number of the scene, which selects the object.")
    ] = 0


@command(DemoOptions)
def demo(options: DemoOptions) -> None:
    from jaxnbv.checks import check_device

    check_device()
    from jaxnbv.cli.play import DEMO, check_options, first_pose, run_episode

    task = TASKS[options.task]
    stop_rule = check_options(options, task.until)
    subject = task.demo(options.scene, options.seed)
    if options.first is not None:
        subject = subject._replace(first=first_pose(options.first, subject.surface))
    run_episode(options, subject, task.setting(), DEMO, stop_rule, has_rival=bool(task.until))


demo.__doc__ = "\n\n".join(
    [
        "Find out what a truck carries, which the first view does not show. Needs no file and no network.",
        "Farthest view, a baseline that ignores the task, starts from the same view.",
        "The object for each --task: "
        + help_sentence((names, example) for example, names in by_task(lambda task: task.example).items()),
    ]
)
