"""Chooses the best pose that an arm can reach. A function of the user checks poses, best first."""

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import InputError, require, short_text
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import is_same_view
from jaxnbv.geometry.rotations import rotation_about
from jaxnbv.search import Proposal

Reachable: TypeAlias = Callable[[Float[np.ndarray, "n 4 4"]], Any]
"""Function of camera-to-world matrices (n, 4, 4) that returns, for each matrix, whether the arm can reach the pose.

The function may return one of three kinds of answers:

- a bool,
- None if the pose can be reached, otherwise the reason as a text such as "joint limit",
- a score from 0 (not reachable) to 1, which multiplies the value of the pose.
"""

# Number of poses in one call of the function.
_BATCH_SIZE = 8
# Rotations about the optical axis, in degrees, that are tried if the arm cannot reach the pose itself.
_ROLLS = (45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
_NO_REASON = "not reachable"


class Choice(NamedTuple):
    """The best pose that can be reached.

    - `proposal`: the search's proposal with this pose and its value.
    - `refusals`: for each reason, the number of poses that cannot be reached.
    """

    proposal: Proposal
    refusals: Mapping[str, int]


class RefusedPose(NamedTuple):
    """A pose that the user refused, in scene coordinates, and the reason."""

    pose: Pose
    reason: str


class _Option(NamedTuple):
    """A pose that can be reached, the pose's value, and the value times the score of the user's function."""

    pose: Pose
    value: float
    weighted: float


@dataclasses.dataclass
class _Checks:
    """Iterable that checks poses in order, and yields for each the options that the arm can reach.

    - `poses`, `values`: poses to check and their values, in order.
    - `answers`: function of a batch of poses. It returns the score of each pose, or the reason why the arm cannot reach
      the pose.
    - `refused`, `values_at`: as in `best_reachable`.
    - `refusals`: for each reason, the number of poses so far that cannot be reached.
    """

    poses: Pose
    values: Float[np.ndarray, " n"]
    answers: Callable[[Pose], list[float | str]]
    refused: Sequence[RefusedPose]
    values_at: Callable[[Pose], Float[Array, " n"]] | None
    refusals: Counter[str] = dataclasses.field(default_factory=Counter)

    def __iter__(self) -> Iterator[list[_Option]]:
        """Yield, for each pose, the list of its options.

        The only option is the pose itself if the arm can reach it. Otherwise the options are the rotations of the pose
        about the optical axis that the arm can reach.
        """
        for start in range(0, len(self.values), _BATCH_SIZE):
            rows = range(start, min(start + _BATCH_SIZE, len(self.values)))
            for row, answer in zip(rows, self.answers(self.poses[jnp.asarray(rows)]), strict=True):
                yield self._options(row, answer)

    def _options(self, row: int, answer: float | str) -> list[_Option]:
        pose, value = self.poses[row], float(self.values[row])
        if (reason := _reason_if_refused(pose, self.refused)) is not None:
            self.refusals[reason] += 1
            return []
        if not isinstance(answer, str):
            return [self._option(pose, value, answer)]
        rolls = _rotations_about_axis(pose)
        scores = {index: score for index, score in enumerate(self.answers(rolls)) if not isinstance(score, str)}
        if not scores:
            self.refusals[answer] += 1
            return []
        values = np.full(len(_ROLLS), value) if self.values_at is None else np.asarray(self.values_at(rolls), float)
        return [self._option(rolls[index], float(values[index]), score) for index, score in scores.items()]

    def _option(self, pose: Pose, value: float, score: float) -> _Option:
        # The search may have proposed a tied pose whose value is not the highest. Therefore values are capped at the
        # value of the proposed pose.
        max_value = min(value, float(self.values[0]))
        return _Option(pose, value, max_value * score if max_value > 0 else max_value)


def best_reachable(
    proposal: Proposal,
    reachable: Reachable | None,
    to_matrices: Callable[[Pose], Float[np.ndarray, "n 4 4"]],
    refused: Sequence[RefusedPose] = (),
    values_at: Callable[[Pose], Float[Array, " n"]] | None = None,
    seconds: float = math.inf,
) -> Choice:
    """Among the poses that the arm can reach, find the pose with the highest product of value and score.

    All poses that the search evaluated are considered. They are checked in batches, highest value first, until no
    unchecked pose can be better. If a pose cannot be reached, the same pose with the camera rotated about its optical
    axis is tried.

    - `reachable`: the user's function, which returns the scores; None if all poses can be reached.
    - `to_matrices`: function that converts scene poses to the matrices for `reachable`.
    - `refused`: poses that are excluded, also with the camera rotated about its optical axis.
    - `values_at`: function that returns the values of rotated poses; None if such a rotation does not change the value,
      as for square images.
    - `seconds`: time limit. After this time, the best pose so far is used.

    **Raises:** `ValueError` if no pose can be reached, or if `reachable` returns an invalid answer.
    """

    def answers(batch: Pose) -> list[float | str]:
        return [1.0 for _ in batch.position] if reachable is None else _answers(reachable, to_matrices(batch))

    poses, values = _evaluated_poses(proposal)
    checks, best, count, start = _Checks(poses, values, answers, refused, values_at), None, 0, time.monotonic()
    for count, options in enumerate(checks, start=1):
        for option in options:
            best = option if best is None or option.weighted > best.weighted else best
        is_best = best is not None and best.weighted >= min(values[count : count + 1], default=-math.inf)
        if is_best or time.monotonic() - start > seconds:
            break
    if best is not None:
        return Choice(_with_pose(proposal, best.pose, best.value), dict(checks.refusals))
    reasons = ", ".join(f"{number} {reason}" for reason, number in checks.refusals.most_common())
    subject = f"{count} of the {len(values)} poses" if count < len(values) else f"{count} poses"
    raise InputError(
        f"none of the {subject} that the search looked at can be reached ({reasons}): give other candidates, "
        f"Session(poses=...), or more{', or more seconds' if count < len(values) else ''}"
    )


def _evaluated_poses(proposal: Proposal) -> tuple[Pose, Float[np.ndarray, " poses"]]:
    """Return all poses that a search evaluated, and their values.

    The proposed pose comes first. The others follow in descending order of value.
    """
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
    """Return a copy of a proposal with a different pose and value.

    The standard error is that of the candidate with this value, or None if there is no such candidate.
    """
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


def _reason_if_refused(pose: Pose, refused: Sequence[RefusedPose]) -> str | None:
    """Return why the user refused a pose or a rotation of it about the optical axis; None if neither."""
    return next((refused_pose.reason for refused_pose in refused if is_same_view(pose, refused_pose.pose)), None)


def _answers(reachable: Reachable, matrices: Float[np.ndarray, "n 4 4"]) -> list[float | str]:
    """Return, for each matrix, a score above 0, or the reason why the arm cannot reach the pose.

    True and None become the score 1. False and the score 0 become the reason "not reachable".

    **Raises:** `ValueError` unless the function returns a list of bools, reasons or scores.
    """
    answers = reachable(matrices)
    is_list = isinstance(answers, list | tuple) or (hasattr(answers, "shape") and len(answers.shape) == 1)
    require(
        is_list and len(answers) == len(matrices),
        f"reachable returned {short_text(answers)} for {len(matrices)} poses: return a list with an answer for each",
    )
    return [_answer(answer) for answer in answers]


def _answer(answer: Any) -> float | str:
    """Convert an answer of the user's function to a score or a reason.

    **Raises:** `ValueError` unless the answer is a bool, None, a string or a number from 0 to 1.
    """
    if answer is None or isinstance(answer, str):
        return 1.0 if answer is None else answer
    is_number = isinstance(answer, bool | int | float) or (hasattr(answer, "dtype") and answer.dtype.kind in "bif")
    require(
        is_number and 0 <= float(answer) <= 1,
        f"reachable returned {short_text(answer)} for a pose: return a bool; None if it can be reached, else the "
        "reason; or a score from 0 to 1",
    )
    return float(answer) or _NO_REASON
