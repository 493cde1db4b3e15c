"""Proposals that an arm can reach: the caller is asked about the best poses first, until one holds."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.checks import InputError, require, shown
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.rotations import rotation_about
from jaxnbv.search import Proposal

Reachable: TypeAlias = Callable[[Float[np.ndarray, "n 4 4"]], Any]
"""A function of matrices, camera to world: a truth for each, or None where it can be reached and else why not."""

# Poses are asked about so many at a time.
_BATCH = 8
# Turns of the camera about its optical axis, in degrees, where the upright image does not hold.
_ROLLS = (45.0, -45.0, 90.0, -90.0, 135.0, -135.0, 180.0)
_UNSAID = "not reachable"
# Poses that differ by less are one, as of `PoseList`.
_SAME = 1e-3


class Choice(NamedTuple):
    """The best pose that can be reached.

    - `proposal`: with this pose and its value; where the camera is turned about its optical axis, that of the search's
      pose.
    - `refusals`: how many poses of more value cannot be reached, by the reason.
    """

    proposal: Proposal
    refusals: Mapping[str, int]


class Refused(NamedTuple):
    """A pose that was refused, in scene coordinates, and why."""

    pose: Pose
    reason: str


def best_reachable(
    proposal: Proposal,
    reachable: Reachable | None,
    to_matrices: Callable[[Pose], Float[np.ndarray, "n 4 4"]],
    refused: Sequence[Refused] = (),
) -> Choice:
    """The pose of a proposal, or if it cannot be reached the one of most value, of all that the search looked at, which
    can. A camera may be turned about its optical axis.

    - `reachable`: the caller's, None for all; `to_matrices`: poses of the scene as it takes them.
    - `refused`: poses that are out of the question, however they are turned.

    **Raises:** `ValueError` if none can be reached, or the function says something else.
    """
    poses, values = _looks(proposal)
    refusals: Counter[str] = Counter()

    def asked(batch: Pose) -> list[str | None]:
        return [None for _ in batch.position] if reachable is None else _answers(reachable, to_matrices(batch))

    for start in range(0, len(values), _BATCH):
        batch = poses[jnp.arange(start, min(start + _BATCH, len(values)))]
        for row, reason in enumerate(asked(batch), start):
            pose, never = poses[row], _refusal(poses[row], refused)
            if never is None and reason is not None:
                turns = _rolled(pose)
                held = [turns[index] for index, why in enumerate(asked(turns)) if why is None]
                pose, reason = (held[0], None) if held else (pose, reason)
            if never is None and reason is None:
                return Choice(_with_pose(proposal, pose, values[row]), dict(refusals))
            refusals[never or reason or _UNSAID] += 1
    reasons = ", ".join(f"{count} {reason}" for reason, count in refusals.most_common())
    raise InputError(
        f"none of the {len(values)} poses that the search looked at can be reached ({reasons}): give other candidates, "
        "Session(poses=...), or more"
    )


def _looks(proposal: Proposal) -> tuple[Pose, Float[Array, " looks"]]:
    """All that a search looked at: the pose that it proposes, then those of most value first."""
    parts = [(proposal.candidates, proposal.values)]
    if proposal.trajectories is not None:
        parts.append(proposal.trajectories.flat)
    poses, values = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    order = np.argsort(-np.asarray(values), kind="stable")
    others = order[np.isfinite(values[order]) & ~_is_near(poses[order], proposal.pose)]
    first = proposal.pose[None], proposal.value[None]
    return jax.tree.map(lambda one, rows: jnp.concatenate([one, rows[others]]), first, (poses, values))


def _with_pose(proposal: Proposal, pose: Pose, value: Float[Array, ""]) -> Proposal:
    """With another pose and its value, and its error where that is known."""
    error, errors, same = proposal.standard_error, proposal.standard_errors, proposal.values == value
    if value != proposal.value:
        error = errors[jnp.argmax(same)] if errors is not None and bool(same.any()) else None
    return dataclasses.replace(proposal, pose=pose, value=value, standard_error=error)


def _rolled(pose: Pose) -> Pose:
    """Turned about its optical axis by each angle, as a batch."""
    axis = jnp.array([0.0, 0.0, 1.0], pose.rotation.dtype)
    turns = jax.vmap(lambda angle: rotation_about(axis, angle))(jnp.radians(jnp.array(_ROLLS, axis.dtype)))
    rotations = jnp.matmul(pose.rotation, turns, precision="highest")
    return Pose(rotations, jnp.broadcast_to(pose.position, (len(_ROLLS), 3)))


def _refusal(pose: Pose, refused: Sequence[Refused]) -> str | None:
    """Why a pose was refused, whatever its roll; None if it was not."""
    return next((one.reason for one in refused if _is_near(pose[None], one.pose)[0]), None)


def _is_near(poses: Pose, pose: Pose) -> Bool[np.ndarray, " n"]:
    """Which of a batch of poses are at the place of one and look the same way."""
    away = [jnp.abs(poses.position - pose.position).max(axis=-1), jnp.abs(poses.forward - pose.forward).max(axis=-1)]
    return np.asarray(jnp.maximum(*away) < _SAME)


def _answers(reachable: Reachable, matrices: Float[np.ndarray, "n 4 4"]) -> list[str | None]:
    """For each matrix None, or why it cannot be reached.

    **Raises:** `ValueError` if the function says neither truths nor reasons.
    """
    said = reachable(matrices)
    is_list = isinstance(said, list | tuple) or (hasattr(said, "shape") and len(said.shape) == 1)
    require(
        is_list and len(said) == len(matrices),
        f"reachable says {shown(said)} of {len(matrices)} poses: give a list of as many answers",
    )
    answers: list[str | None] = []
    for one in said:
        is_truth = isinstance(one, bool | np.bool_) or (hasattr(one, "dtype") and one.dtype == bool)
        require(
            one is None or isinstance(one, str) or is_truth,
            f"reachable says {shown(one)} of a pose: give a truth; or None if it can be reached, else why not",
        )
        answers.append(one if one is None or isinstance(one, str) else None if bool(one) else _UNSAID)
    return answers
