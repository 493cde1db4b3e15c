"""Many simulated episodes in one compiled program."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jax.sharding import Mesh, get_abstract_mesh
from jaxtyping import Array, Bool, Float, Key

from jaxnbv.checks import InputError, checked, is_traced, require, short_text
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.episode_program import answers_by_parts, run
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.simulate import check_num_views
from jaxnbv.scanning import Noise, SensorNoise, Surface
from jaxnbv.scanning.scanner import distance_problem
from jaxnbv.scanning.scene_batch import scene_batch
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.sharding import on_cpu, rows_per_device
from jaxnbv.surfaces import KnownShapes
from jaxnbv.tasks.identification import weights_by_name


class Episodes(eqx.Module):
    """Results of `episodes` in scene coordinates. All arrays have a leading axis of episodes.

    - `poses`: poses of the views, (episodes, views).
    - `values`: value that the search gave each view; NaN for the first view.
    - `clouds`: the cloud D after the last view.
    - `answers`: values of `View.answer` after each view. None if there is no answer, or if the answer needs code
      outside JAX.
    """

    poses: Pose
    values: Float[Array, "episodes views"]
    clouds: PointCloud
    answers: Float[Array, "episodes views n"] | None


@checked
def episodes(
    planner: Planner,
    scenes: Surface | SignedDistance | trimesh.Geometry | Sequence,
    first: Pose,
    views: int,
    keys: Key[Array, " episodes"],
    noise: Noise = SensorNoise(),
    batch_size: int | None = None,
) -> Episodes:
    """Simulate a batch of episodes in one compiled program.

    The results are those of `simulate` for each scene and key. On a CPU with the default `batch_size`, poses, values,
    clouds and answers equal those of `simulate` bit for bit. The episodes are split among the devices of
    `jax.set_mesh`, by default among all local devices.

    - `scenes`: a list with one solid or surface for each key, all of the same structure. `[scene] * len(keys)` repeats
      a scene. You can also pass a single solid or surface whose arrays have a leading axis, as `jax.vmap` returns.
    - `first`: pose of the first view, or a batch with one pose for each key.
    - `views`: number of views of each episode. The same compiled program serves any number.
    - `keys`: a random key for each episode, from `jax.random.split(key, episodes)`.
    - `batch_size`: number of episodes that a device computes together. The default is one on a CPU, and all episodes of
      the device on a GPU. More episodes need more memory. If it is greater than one, the values equal those of
      `simulate` only up to rounding.

    **Raises:** `ValueError` for triangle meshes, scenes of different structures, different numbers of scenes and keys,
    `views` less than 1 or greater than the planner's `max_views`, a first view that sees nothing, or a view whose value
    is not finite.
    """
    check_num_views(planner, views)
    require(batch_size is None or batch_size >= 1, f"the batch size is {batch_size}; it must be at least 1")
    are_keys = isinstance(keys, Array) and jnp.issubdtype(keys.dtype, jax.dtypes.prng_key)
    require(
        are_keys and keys.ndim == 1 and keys.size > 0,
        f"the keys are {short_text(keys)}: make them with jax.random.split(jax.random.key(seed), episodes)",
    )
    require(not is_traced(scenes, first, keys), "episodes is a compiled program itself: call it outside jit and vmap")
    count = len(keys)
    rows = scene_batch(scenes, count), _batch_of_poses(first, count), keys
    # The value of the first view is NaN, so JAX must not check for NaN.
    with _devices(count), jax.debug_nans(False):
        at_once = min(batch_size or (1 if on_cpu() else count), rows_per_device(count))
        records, clouds, sees_object = run(planner, noise, jnp.asarray(views), rows, at_once)
        poses, values, answers = jax.tree.map(lambda leaf: leaf[:, :views], records)
    _check(planner, np.asarray(values), clouds, np.asarray(sees_object))
    if answers is not None and answers_by_parts(planner):
        assert isinstance(planner.sampler.model, KnownShapes)
        _, weights = weights_by_name(planner.sampler.model.bank, np.asarray(answers), planner.acquisition)
        answers = jnp.asarray(weights, answers.dtype)
    return Episodes(poses, values, clouds, answers)


def _batch_of_poses(first: Pose, count: int) -> Pose:
    """Return the first pose of each episode, as a batch (count,), from one pose or `count` poses."""
    batch = first.position.shape[:-1]
    require(
        batch in ((), (count,)),
        f"the first pose is a batch {batch} of poses for {count} keys: give one pose, or one for each key",
    )
    problem = distance_problem(first)
    require(problem is None, f"the first pose is not of the scene: {problem}")
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape[len(batch) :])), first)


def _devices(count: int) -> AbstractContextManager:
    """Context manager: use the user's mesh of devices, or else at most `count` local devices."""
    is_chosen = not get_abstract_mesh().empty or jax.config.jax_default_device is not None  # type: ignore[attr-defined]
    devices = jax.local_devices()[:count]
    return nullcontext() if is_chosen or len(devices) == 1 else jax.set_mesh(Mesh(np.array(devices), "devices"))


def _check(
    planner: Planner, values: Float[np.ndarray, "b v"], clouds: PointCloud, sees_object: Bool[np.ndarray, " b"]
) -> None:
    """Raise `ValueError` if a first view sees nothing, an answer is invalid, or a value is not finite."""
    require(
        bool(sees_object.all()),
        f"the first view of episode {sees_object.argmin()} sees nothing: point the camera at the object",
    )
    if planner.search.uses_samples:
        planner.acquisition.check(clouds[0])
    for episode, view in np.argwhere(~np.isfinite(values[:, 1:])):
        value = values[episode, view + 1]
        all_visited = "all candidates have been visited, or no camera may stand there: give the search more candidates"
        not_finite = "call simulate with its scene and key, which names the cause"
        raise InputError(
            f"the value of view {view + 2} of episode {episode} is {value}: {all_visited if value < 0 else not_finite}"
        )
