"""The compiled program of simulated episodes, which computes what `simulate` does, in JAX only."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PRNGKeyArray

from jaxnbv.acquisition import Acquisition
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.pose_list import PoseList
from jaxnbv.observations import Observations
from jaxnbv.planning.loop import view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.program_parts import in_parts
from jaxnbv.planning.simulate import observe_scene
from jaxnbv.programs import program
from jaxnbv.scanning import Noise, Surface
from jaxnbv.sharding import batched_map, run_sharded
from jaxnbv.surfaces.part_hypotheses import hypotheses_of


class ViewRecord(NamedTuple):
    """Result of one view of a simulated episode.

    - `value`: value that the search gave the view; NaN for the first view.
    - `answer`: values of the acquisition's answer, or `part_weights` if `answers_by_parts`; None without an answer.
    """

    pose: Pose
    value: Float[Array, ""]
    answer: Float[Array, " n"] | None


def answers_by_parts(planner: Planner) -> bool:
    """Return whether `View.answer` is the probability of each part, for an acquisition without an answer."""
    return type(planner.acquisition).answer is Acquisition.answer and planner.sampler.model.carries_hypotheses


@program
def run(
    planner: Planner,
    noise: Noise,
    views: Int[Array, ""],
    rows: tuple[Surface, Pose, Key[Array, " episodes"]],
    at_once: int,
) -> tuple[ViewRecord, PointCloud, Bool[Array, " episodes"]]:
    """Return records of the episodes' views, the last clouds, and whether each first view sees the object.

    The records' arrays have axes (episodes, max_views), and are zero after the last view.

    - `views`: number of views of each episode.
    - `rows`: scene, first pose and random key of each episode. The leading axis is split among the devices.
    - `at_once`: number of episodes that a device computes together.
    """

    def simulate_share(rows: Any, planner: Planner, views: Int[Array, ""]) -> Any:
        return batched_map(lambda row: _episode(planner, noise, views, *row), rows, at_once)

    return run_sharded(simulate_share, rows, planner, views)


def _episode(
    planner: Planner, noise: Noise, views: Int[Array, ""], scene: Surface, first: Pose, key: PRNGKeyArray
) -> tuple[ViewRecord, PointCloud, Bool[Array, ""]]:
    max_views = planner.max_views
    observations, record, sees_object = in_parts(_first_view, planner, noise, scene, first, key)
    records = jax.tree.map(lambda leaf: jnp.zeros((max_views, *leaf.shape), leaf.dtype).at[0].set(leaf), record)
    arrays, static = eqx.partition(observations, eqx.is_array)

    # The number of iterations is traced, so the same program serves any number of views.
    def add(index: Any, state: Any) -> Any:
        arrays, pending, records = state
        observations = eqx.combine(arrays, static)
        observations, pending, record = in_parts(_next_view, planner, noise, scene, key, index, observations, pending)
        records = jax.tree.map(lambda rows, row: rows.at[index].set(row), records, record)
        return eqx.filter(observations, eqx.is_array), pending, records

    arrays, _, records = jax.lax.fori_loop(1, views, add, (arrays, PoseList.empty(max_views), records))
    return records, eqx.combine(arrays, static).cloud, sees_object


def _first_view(
    planner: Planner, noise: Noise, scene: Surface, first: Pose, key: PRNGKeyArray
) -> tuple[Observations, ViewRecord, Bool[Array, ""]]:
    *_, noise_key = view_keys(key, 0)
    scan = observe_scene(scene, planner.camera, first, noise, noise_key, planner.obstacles)
    observations = planner.init(first, scan)
    value = jnp.full((), jnp.nan, first.position.dtype)
    return observations, ViewRecord(first, value, _answer(planner, observations)), jnp.any(scan.mask)


def _next_view(
    planner: Planner,
    noise: Noise,
    scene: Surface,
    key: PRNGKeyArray,
    index: Int[Array, ""],
    observations: Observations,
    pending: PoseList,
) -> tuple[Observations, PoseList, ViewRecord]:
    sample_key, search_key, noise_key = view_keys(key, index)
    proposal = planner.choose(planner.step_inputs(observations, sample_key), search_key, pending)
    scan = observe_scene(scene, planner.camera, proposal.pose, noise, noise_key, planner.obstacles)
    observations = planner.observe(observations, proposal.pose, scan)
    record = ViewRecord(proposal.pose, proposal.value, _answer(planner, observations))
    return observations, pending.append(proposal.pose), record


def _answer(planner: Planner, observations: Observations) -> Float[Array, " n"] | None:
    if answers_by_parts(planner):
        return hypotheses_of(observations).part_weights
    return planner.acquisition.answer_values(observations.cloud)
