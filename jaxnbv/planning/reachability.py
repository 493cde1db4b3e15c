"""Choice of the best pose that an arm can reach. A function of the user tells which poses those are."""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnbv.checks import InputError, require, short_text
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import is_same_view
from jaxnbv.geometry.rotations import rotation_about
from jaxnbv.planning.loop import Loop
from jaxnbv.search import Proposal

Reachable: TypeAlias = Callable[[Float[np.ndarray, "n 4 4"]], Any]
"""Function of camera-to-world matrices (n, 4, 4) that returns, for each matrix, whether the arm can reach the pose.

An answer is a bool, or a score from 0 (not reachable) to 1 that multiplies the value of the pose. It may also be the
reason why the arm cannot reach the pose, such as "joint limit", or None if the arm can reach the pose.
"""

# Number of poses in each call of the user's function.
_BATCH_SIZE = 8
# If the arm cannot reach a pose, these rotations of the pose about the optical axis are tried (degrees).
_ROLLS = (45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
_NO_REASON = "not reachable"


class RefusedPose(NamedTuple):
    """A scene pose that the user refused, and the reason."""

    pose: Pose
    reason: str


class _Option(NamedTuple):
    """A pose that the arm can reach, its value, and its score from the user's function."""

    pose: Pose
    value: float
    score: float


def best_reachable(
    loop: Loop,
    reachable: Reachable | None,
    to_matrices: Callable[[Pose], Float[np.ndarray, "n 4 4"]],
    refused_poses: Sequence[RefusedPose],
    seconds: float,
) -> tuple[Proposal, dict[str, int]]:
    """Propose the pose with the highest product of value and score, among poses that the arm can reach.

    This pose and its value become the loop's proposal. Return the proposal and, for each reason, the number of poses
    rejected for this reason. The poses that the search evaluated are checked in batches, highest value first, until no
    unchecked pose can be better. If the arm cannot reach a pose, rotations of it about the optical axis are tried.

    - `reachable`: the user's function; None if all poses can be reached.
    - `to_matrices`: function that converts scene poses to the matrices for `reachable`.
    - `refused_poses`: poses that are excluded at any rotation about their optical axis.
    - `seconds`: time after which the best pose so far is used.

    **Raises:** `ValueError` if no pose can be reached, if `reachable` returns an invalid answer, and whenever
    `Loop.propose` raises it.
    """
    proposal = loop.propose()
    if reachable is None and not refused_poses:
        return proposal, {}

    def answers(batch: Pose) -> list[float | str]:
        return [1.0 for _ in batch.position] if reachable is None else _answers(reachable, to_matrices(batch))

    poses, values = _evaluated_poses(proposal)
    refusals: Counter[str] = Counter()
    best, best_value, count, start = None, -math.inf, 0, time.monotonic()
    for count, options in enumerate(_options(loop, poses, values, answers, refused_poses, refusals), start=1):
        for option in options:
            # The search may have proposed a tied pose whose value is not the highest. Therefore values are capped at
            # the value of the proposed pose.
            value = min(option.value, float(values[0]))
            value = value * option.score if value > 0 else value
            if best is None or value > best_value:
                best, best_value = option, value
        is_best = best is not None and best_value >= min(values[count : count + 1], default=-math.inf)
        if is_best or time.monotonic() - start > seconds:
            break
    if best is not None:
        proposal = _with_pose(proposal, best.pose, best.value)
        loop.replace_proposal(proposal)
        return proposal, dict(refusals)
    reasons = ", ".join(f"{number} {reason}" for reason, number in refusals.most_common())
    subject = f"{count} of the {len(values)} poses" if count < len(values) else f"{count} poses"
    raise InputError(
        f"none of the {subject} that the search looked at can be reached ({reasons}): give other candidates, "
        f"Session(poses=...), or more{', or more seconds' if count < len(values) else ''}"
    )


def _options(
    loop: Loop,
    poses: Pose,
    values: Float[np.ndarray, " poses"],
    answers: Callable[[Pose], list[float | str]],
    refused_poses: Sequence[RefusedPose],
    refusals: Counter[str],
) -> Iterator[list[_Option]]:
    """Yield, for each pose in order, the list of options that the arm can reach.

    The only option is the pose itself if the arm can reach it. Otherwise the options are its rotations about the
    optical axis that the arm can reach. If the list is empty, the reason is counted in `refusals`.

    - `answers`: function of a batch of poses. For each pose it returns the score, or the reason why the arm cannot
      reach the pose.
    """
    for start in range(0, len(values), _BATCH_SIZE):
        rows = range(start, min(start + _BATCH_SIZE, len(values)))
        for row, answer in zip(rows, answers(poses[jnp.asarray(rows)]), strict=True):
            pose, value = poses[row], float(values[row])
            options: list[_Option] = []
            if (reason := _reason_if_refused(pose, refused_poses)) is not None:
                refusals[reason] += 1
            elif not isinstance(answer, str):
                options = [_Option(pose, value, answer)]
            elif not (options := _rolled_options(loop, pose, value, answers)):
                refusals[answer] += 1
            yield options


def _rolled_options(
    loop: Loop, pose: Pose, value: float, answers: Callable[[Pose], list[float | str]]
) -> list[_Option]:
    rolls = _rotations_about_axis(pose)
    scores = {index: score for index, score in enumerate(answers(rolls)) if not isinstance(score, str)}
    values = np.full(len(_ROLLS), value)
    if scores and loop.planner.search.uses_samples:
        # A rotated image shows other surface at its corners.
        values = np.asarray(loop.planner.values_at(loop.inputs(), rolls), float)
    return [_Option(rolls[index], float(values[index]), score) for index, score in scores.items()]


def _evaluated_poses(proposal: Proposal) -> tuple[Pose, Float[np.ndarray, " poses"]]:
    """Return the evaluated poses and their values: the proposed pose, then the rest by decreasing value."""
    parts = [(proposal.candidates, proposal.values)]
    if proposal.trajectories is not None:
        parts.append(proposal.trajectories.flat)
    poses, values = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    order = np.argsort(-np.asarray(values), kind="stable")
    others = order[np.isfinite(values[order]) & ~np.asarray(is_same_view(poses[order], proposal.pose))]
    first = proposal.pose[None], proposal.value[None]
    poses, values = jax.tree.map(lambda one, rows: jnp.concatenate([one, rows[others]]), first, (poses, values))
    return poses, np.asarray(values)


def _with_pose(proposal: Proposal, pose: Pose, value: float) -> Proposal:
    """Return a copy that proposes this pose and value, and the value's standard error if it is known."""
    error, errors, is_same = proposal.standard_error, proposal.standard_errors, proposal.values == value
    if value != float(proposal.value):
        error = errors[jnp.argmax(is_same)] if errors is not None and bool(is_same.any()) else None
    array = jnp.asarray(value, proposal.value.dtype)
    return dataclasses.replace(proposal, pose=pose, value=array, standard_error=error)


def _rotations_about_axis(pose: Pose) -> Pose:
    """Rotate a pose about its optical axis by each angle of `_ROLLS`, and return the poses as a batch."""
    axis = jnp.array([0.0, 0.0, 1.0], pose.rotation.dtype)
    matrices = jax.vmap(lambda angle: rotation_about(axis, angle))(jnp.radians(jnp.array(_ROLLS, axis.dtype)))
    rotations = jnp.matmul(pose.rotation, matrices, precision="highest")
    return Pose(rotations, jnp.broadcast_to(pose.position, (len(_ROLLS), 3)))


def _reason_if_refused(pose: Pose, refused_poses: Sequence[RefusedPose]) -> str | None:
    """Return why the user refused this view, at any rotation about the optical axis; None if not refused."""
    return next((refused.reason for refused in refused_poses if is_same_view(pose, refused.pose)), None)


def _answers(reachable: Reachable, matrices: Float[np.ndarray, "n 4 4"]) -> list[float | str]:
    """Return, for each matrix, a score above 0, or the reason why the arm cannot reach the pose."""
    answers = reachable(matrices)
    is_list = isinstance(answers, list | tuple) or (hasattr(answers, "shape") and len(answers.shape) == 1)
    require(
        is_list and len(answers) == len(matrices),
        f"reachable returned {short_text(answers)} for {len(matrices)} poses: return a list with an answer for each",
    )
    return [_answer(answer) for answer in answers]


def _answer(answer: Any) -> float | str:
    """Convert an answer to a score or a reason. True and None become the score 1, False and 0 a reason."""
    if answer is None or isinstance(answer, str):
        return 1.0 if answer is None else answer
    is_number = isinstance(answer, bool | int | float) or (hasattr(answer, "dtype") and answer.dtype.kind in "bif")
    require(
        is_number and 0 <= float(answer) <= 1,
        f"reachable returned {short_text(answer)} for a pose: return a bool; None if it can be reached, else the "
        "reason; or a score from 0 to 1",
    )
    return float(answer) or _NO_REASON
