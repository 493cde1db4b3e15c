"""Proposals that an arm can reach: the caller is asked about the best poses first, until one holds."""

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

from jaxnbv.checks import InputError, require, shown
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import is_same_view
from jaxnbv.geometry.rotations import rotation_about
from jaxnbv.search import Proposal

Reachable: TypeAlias = Callable[[Float[np.ndarray, "n 4 4"]], Any]
"""Says of matrices, camera to world, whether the arm can go there. An answer for each: a truth; None if it can, else
the reason why not; or a score from 0, not at all, to 1, by which the value of the pose is multiplied."""

# Poses that are asked about at once.
_BATCH = 8
# Turns of the camera about its optical axis, in degrees, where the upright image does not hold.
_ROLLS = (45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
_NO_REASON = "not reachable"


class Choice(NamedTuple):
    """The best pose that can be reached.

    - `proposal`: with this pose and its value; `refusals`: how many poses cannot be reached, by the reason.
    """

    proposal: Proposal
    refusals: Mapping[str, int]


class Refused(NamedTuple):
    """A pose that was refused, in scene coordinates, and why."""

    pose: Pose
    reason: str


class _Option(NamedTuple):
    """A pose that can be reached, its value, and the value that it is chosen by."""

    pose: Pose
    value: float
    weighted: float


@dataclasses.dataclass
class _Asked:
    """What a caller says of poses, those of most value first.

    - `poses`, `values`: in the order in which they are asked about; `refusals`: counted as they come.
    """

    poses: Pose
    values: Float[np.ndarray, " n"]
    answers: Callable[[Pose], list[float | str]]
    refused: Sequence[Refused]
    values_at: Callable[[Pose], Float[Array, " n"]] | None
    refusals: Counter[str] = dataclasses.field(default_factory=Counter)

    def __iter__(self) -> Iterator[list[_Option]]:
        """The options of each pose in its order: itself, or turned about its optical axis."""
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
        # The search breaks ties its own way: no pose counts for more than the one that it proposes.
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
    """The pose of most value, times its score, among all that the search looked at and the arm can reach.

    Poses are asked about in batches, those of most value first, until no other can be worth more. A pose that cannot
    be reached is tried with the camera turned about its optical axis.

    - `reachable`: the caller's, None if all can be reached; `to_matrices`: converts poses of the scene for it.
    - `refused`: poses that are out of the question, however they are turned.
    - `values_at`: the values of turned poses; None if a turned image is worth the same, as a square one is.
    - `seconds`: after this time no more is asked, and the best pose so far is taken.

    **Raises:** `ValueError` if none can be reached, or the function answers something else.
    """

    def answers(batch: Pose) -> list[float | str]:
        return [1.0 for _ in batch.position] if reachable is None else _answers(reachable, to_matrices(batch))

    poses, values = _looks(proposal)
    asked, best, count, start = _Asked(poses, values, answers, refused, values_at), None, 0, time.monotonic()
    for count, options in enumerate(asked, start=1):
        for option in options:
            best = option if best is None or option.weighted > best.weighted else best
        is_best = best is not None and best.weighted >= min(values[count : count + 1], default=-math.inf)
        if is_best or time.monotonic() - start > seconds:
            break
    if best is not None:
        return Choice(_with_pose(proposal, best.pose, best.value), dict(asked.refusals))
    reasons = ", ".join(f"{number} {reason}" for reason, number in asked.refusals.most_common())
    which = f"{count} of the {len(values)} poses" if count < len(values) else f"{count} poses"
    raise InputError(
        f"none of the {which} that the search looked at can be reached ({reasons}): give other candidates, "
        f"Session(poses=...), or more{', or more seconds' if count < len(values) else ''}"
    )


def _looks(proposal: Proposal) -> tuple[Pose, Float[np.ndarray, " looks"]]:
    """All that a search looked at: the pose that it proposes, then those of most value first."""
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
    """With another pose and its value, and its error where that is known."""
    error, errors, same = proposal.standard_error, proposal.standard_errors, proposal.values == value
    if value != float(proposal.value):
        error = errors[jnp.argmax(same)] if errors is not None and bool(same.any()) else None
    own = jnp.asarray(value, proposal.value.dtype)
    return dataclasses.replace(proposal, pose=pose, value=own, standard_error=error)


def _rolled(pose: Pose) -> Pose:
    """Turned about its optical axis by each angle, as a batch."""
    axis = jnp.array([0.0, 0.0, 1.0], pose.rotation.dtype)
    turns = jax.vmap(lambda angle: rotation_about(axis, angle))(jnp.radians(jnp.array(_ROLLS, axis.dtype)))
    rotations = jnp.matmul(pose.rotation, turns, precision="highest")
    return Pose(rotations, jnp.broadcast_to(pose.position, (len(_ROLLS), 3)))


def _refusal(pose: Pose, refused: Sequence[Refused]) -> str | None:
    """Why a pose was refused, whatever its roll; None if it was not."""
    return next((one.reason for one in refused if is_same_view(pose, one.pose)), None)


def _answers(reachable: Reachable, matrices: Float[np.ndarray, "n 4 4"]) -> list[float | str]:
    """For each matrix its score, or why it cannot be reached.

    **Raises:** `ValueError` if the function answers anything but truths, reasons and scores.
    """
    said = reachable(matrices)
    is_list = isinstance(said, list | tuple) or (hasattr(said, "shape") and len(said.shape) == 1)
    require(
        is_list and len(said) == len(matrices),
        f"reachable says {shown(said)} of {len(matrices)} poses: give a list of as many answers",
    )
    return [_answer(one) for one in said]


def _answer(said: Any) -> float | str:
    """**Raises:** `ValueError` for what is no truth, no reason and no score."""
    if said is None or isinstance(said, str):
        return 1.0 if said is None else said
    is_number = isinstance(said, bool | int | float) or (hasattr(said, "dtype") and said.dtype.kind in "bif")
    require(
        is_number and 0 <= float(said) <= 1,
        f"reachable says {shown(said)} of a pose: give a truth; None if it can be reached, else why not; or a score "
        "from 0 to 1",
    )
    return float(said) or _NO_REASON
