"""Episodes of a study: views one by one, for as long as the study wants more."""

from collections.abc import Iterator

import jax
from jaxtyping import PRNGKeyArray

from jaxnbv.camera import Camera, Pose
from jaxnbv.episode import View, observe_scene, view_keys
from jaxnbv.planner import Planner
from jaxnbv.scanning import SensorNoise, Surface


def planned_views(
    planner: Planner,
    scene: Surface,
    first: Pose,
    key: PRNGKeyArray,
    noise: SensorNoise = SensorNoise(),
    sensor: Camera | None = None,
) -> Iterator[View]:
    """Scan a known surface from `first`, then from the views that the planner asks for, until it has room for no more.

    `sensor` is the camera of the true scans, by default the planner's; one of more rays than are imagined saves time.
    View i depends on the key and i alone, and is that of `jaxnbv.simulate`: planners that differ in their search or
    their acquisition are compared under the same sensor noise, and under the same prior samples at the same view.

    **Raises:** `ValueError` as `Planner.init`, `propose` and `observe` do; among others when every candidate has been
    visited.
    """
    sensor = planner.camera if sensor is None else sensor
    _, _, noise_key = view_keys(key, 0)
    seen = observe_scene(scene, sensor, first, noise, noise_key)
    state = planner.init(seen, first, sensor)
    yield View(first, seen, state.cloud, None)
    for index in range(1, planner.max_views):
        sample_key, search_key, noise_key = view_keys(key, index)
        surfaces = planner.sample_surfaces(state, sample_key) if planner.search.uses_samples else None
        proposal = jax.block_until_ready(planner.choose(state, surfaces, search_key))
        seen = observe_scene(scene, sensor, proposal.pose, noise, noise_key)
        state = planner.observe(state, proposal.pose, seen, sensor)
        yield View(proposal.pose, seen, state.cloud, proposal)
