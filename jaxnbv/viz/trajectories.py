"""What a gradient search passed through, as plain arrays, and the acquisition all over the sphere beside it."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxnbv.acquisition import expected_value
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode import Episode, view_keys
from jaxnbv.search import Proposal, SphereCandidates, Trajectories
from jaxnbv.viz.sphere import unit

# Fewer candidates than this say little about what lies between them: the map is then made of so many views of its own.
_FEWEST = 30
MAP_VIEWS = 120


class SphereMap(eqx.Module):
    """Values of cameras that look at the origin, from which the map over the sphere is interpolated.

    - `directions`: unit vectors from the origin to them; `values`: theirs, NaN where excluded as visited.
    """

    directions: Float[np.ndarray, "c 3"]
    values: Float[np.ndarray, " c"]


class Ascents(eqx.Module):
    """The trajectories of a gradient search, from each of its starts to where it ended.

    - `poses`: with leading axes (starts, steps).
    - `directions`: unit vectors from the origin to their positions; `values`: theirs.
    """

    poses: Pose
    directions: Float[np.ndarray, "starts steps 3"]
    values: Float[np.ndarray, "starts steps"]

    @property
    def is_spatial(self) -> bool:
        """Whether cameras left the sphere that they started from, or looked past its centre."""
        return not _on_sphere(self.poses)


def _on_sphere(poses: Pose) -> bool:
    """Whether all cameras stand at one distance from the origin and look at it."""
    positions = np.asarray(poses.position, dtype=np.float64)
    past = np.asarray(poses.forward, dtype=np.float64) + unit(positions)
    return bool(np.ptp(np.linalg.norm(positions, axis=-1)) < 1e-3 and np.linalg.norm(past, axis=-1).max() < 1e-3)


def ascents_of(trajectories: Trajectories) -> Ascents:
    """The trajectories of a proposal as directions and values."""
    positions = np.asarray(trajectories.poses.position, dtype=np.float64)
    return Ascents(trajectories.poses, unit(positions), np.asarray(trajectories.values, dtype=np.float64))


def open_values(proposal: Proposal) -> Float[np.ndarray, " c"]:
    """The values of a proposal's candidates, NaN where one was excluded as visited."""
    values = np.asarray(proposal.values, dtype=np.float64)
    return np.where(np.isfinite(values), values, np.nan)


def wider_map(episode: Episode, index: int) -> SphereMap | None:
    """What to draw the map of view `index` (from 0) from, where the candidates of a gradient search do not make one.

    They are too few, or not cameras on one sphere that look at its centre. None where they will do.

    The posterior samples are those of the step, so that values can be compared with the search's own.
    """
    proposal = episode.views[index].proposal
    if proposal is None or proposal.trajectories is None:
        return None
    if np.sum(~np.isnan(open_values(proposal))) >= _FEWEST and _on_sphere(proposal.candidates):
        return None
    radius = float(np.median(np.linalg.norm(np.asarray(proposal.candidates.position), axis=-1)))
    poses = SphereCandidates(MAP_VIEWS, radius).poses()
    return SphereMap(unit(np.asarray(poses.position, dtype=np.float64)), step_values(episode, index, poses))


def step_values(episode: Episode, index: int, poses: Pose) -> Float[np.ndarray, " poses"]:
    """The acquisition at a batch of poses, with the samples of the step that chose view `index` (from 0)."""
    planner, evidence = episode.planner, episode.evidence_after(index)
    sample_key, *_ = view_keys(episode.key, index)
    surfaces = planner.imagination.sample(evidence, sample_key)
    barrier = planner.imagination.barrier(planner.camera, poses)
    found = _expected(planner.acquisition, evidence.cloud, surfaces, planner.camera, poses, barrier)
    return np.asarray(found, dtype=np.float64)


_expected = eqx.filter_jit(expected_value)
