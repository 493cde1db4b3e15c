"""Proposals that an arm can reach: poses are checked by the user's function, the best ones first."""

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
"""Function of matrices (n, 4, 4), camera to world, that returns for each whether the arm can go there.

An answer is a bool; or None if it can and otherwise the reason; or a score from 0 (not at all) to 1, which multiplies
the value of the pose."""

# Number of poses in one call of the function.
_BATCH = 8
# Turns of the camera about its optical axis, in degrees, that are tried if the upright camera cannot reach a pose.
_ROLLS = (45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
_NO_REASON = "not reachable"


class Choice(NamedTuple):
    """The best pose that can be reached.

    - `proposal`: the search's proposal with this pose and its value.
    - `refusals`: number of poses that cannot be reached, by reason.
    """

    proposal: Proposal
    refusals: Mapping[str, int]


class Refused(NamedTuple):
    """A pose that was refused, in scene coordinates, and the reason."""

    pose: Pose
    reason: str


class _Option(NamedTuple):
    """A pose that can be reached, its value, and the value times its score."""

    pose: Pose
    value: float
    weighted: float


@dataclasses.dataclass
class _Checks:
    """Iterator over poses, from the highest value, with the answers of the user's function.

    - `poses`, `values`: poses and values in the order in which they are checked.
    - `refusals`: counts of the reasons so far.
    """

    poses: Pose
    values: Float[np.ndarray, " n"]
    answers: Callable[[Pose], list[float | str]]
    refused: Sequence[Refused]
    values_at: Callable[[Pose], Float[Array, " n"]] | None
    refusals: Counter[str] = dataclasses.field(default_factory=Counter)

    def __iter__(self) -> Iterator[list[_Option]]:
        """Yield the options for each pose in order: the pose itself, or turned about its optical axis."""
        for start in range(0, len(self.values), _BATCH):
            rows = range(start, min(start + _BATCH, len(self.values)))
            for row, answer in zip(rows, self.answers(self.poses[jnp.asarray(rows)]), strict=True):
                yield self._options(row, answer)

    def _options(self, row: int, answer: float | str) -> list[_Option]:
        pose, value = self.poses[row], float(self.values[row])
        if (reason := _refusal(pose, self.refused)) is not None:
            self.refusals[reason] += 1
            return []
        if not isinstance(answer, str):
            return [self._option(pose, value, answer)]
        turned = _rolled(pose)
        scores = {index: score for index, score in enumerate(self.answers(turned)) if not isinstance(score, str)}
        if not scores:
            self.refusals[answer] += 1
            return []
        values = np.full(len(_ROLLS), value) if self.values_at is None else np.asarray(self.values_at(turned), float)
        return [self._option(turned[index], float(values[index]), score) for index, score in scores.items()]

    def _option(self, pose: Pose, value: float, score: float) -> _Option:
        # The search may break ties by other criteria, so no pose counts more than the proposed one.
        least = min(value, float(self.values[0]))
        return _Option(pose, value, least * score if least > 0 else least)


def best_reachable(
    proposal: Proposal,
    reachable: Reachable | None,
    to_matrices: Callable[[Pose], Float[np.ndarray, "n 4 4"]],
    refused: Sequence[Refused] = (),
    values_at: Callable[[Pose], Float[Array, " n"]] | None = None,
    seconds: float = math.inf,
) -> Choice:
    """Find the reachable pose with the highest value times score, among all poses of the search.

    Poses are checked in batches, those of the highest value first, until no other can be better. A pose that cannot be
    reached is tried with the camera turned about its optical axis.

    - `reachable`: function of the user; None if all poses can be reached.
    - `to_matrices`: converts poses of the scene to matrices for it.
    - `refused`: poses that are excluded in any roll.
    - `values_at`: function that returns the values of turned poses; None if turning does not change the value, as for
      square images.
    - `seconds`: time limit. After it, the best pose so far is used.

    **Raises:** `ValueError` if no pose can be reached, or if the function returns something else.
    """

    def answers(batch: Pose) -> list[float | str]:
        return [1.0 for _ in batch.position] if reachable is None else _answers(reachable, to_matrices(batch))

    poses, values = _looks(proposal)
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
    which = f"{count} of the {len(values)} poses" if count < len(values) else f"{count} poses"
    raise InputError(
        f"none of the {which} that the search looked at can be reached ({reasons}): give other candidates, "
        f"Session(poses=...), or more{', or more seconds' if count < len(values) else ''}"
    )


def _looks(proposal: Proposal) -> tuple[Pose, Float[np.ndarray, " looks"]]:
    """All poses that a search evaluated, with values: the proposed pose, then the others from the highest value."""
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
    """The proposal with another pose and its value, and with its standard error if that is known."""
    error, errors, same = proposal.standard_error, proposal.standard_errors, proposal.values == value
    if value != float(proposal.value):
        error = errors[jnp.argmax(same)] if errors is not None and bool(same.any()) else None
    own = jnp.asarray(value, proposal.value.dtype)
    return dataclasses.replace(proposal, pose=pose, value=own, standard_error=error)


def _rolled(pose: Pose) -> Pose:
    """The pose turned about its optical axis by each angle of `_ROLLS`, as a batch."""
    axis = jnp.array([0.0, 0.0, 1.0], pose.rotation.dtype)
    turns = jax.vmap(lambda angle: rotation_about(axis, angle))(jnp.radians(jnp.array(_ROLLS, axis.dtype)))
    rotations = jnp.matmul(pose.rotation, turns, precision="highest")
    return Pose(rotations, jnp.broadcast_to(pose.position, (len(_ROLLS), 3)))


def _refusal(pose: Pose, refused: Sequence[Refused]) -> str | None:
    """The reason why a pose was refused, in any roll; None if it was not."""
    return next((earlier.reason for earlier in refused if is_same_view(pose, earlier.pose)), None)


def _answers(reachable: Reachable, matrices: Float[np.ndarray, "n 4 4"]) -> list[float | str]:
    """The score of each matrix, or the reason why it cannot be reached.

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
    """The score or reason that an answer stands for.

    **Raises:** `ValueError` unless it is a bool, None, a reason or a score.
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
