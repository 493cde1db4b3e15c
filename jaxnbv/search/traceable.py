"""Check that JAX can trace an acquisition, before a search runs."""

import jax
import jax.numpy as jnp

from jaxnbv.acquisition import Acquisition, ImaginedView, inputs_of
from jaxnbv.checks import InputError, functions_of_users
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations


def check_traceable(
    acquisition: Acquisition, observations: Observations | int, camera: Camera, differentiable: bool = False
) -> None:
    """Check that JAX can trace an acquisition. The check uses only shapes and computes nothing.

    - `observations`: observations, or the capacity of a cloud D.
    - `differentiable`: whether to check also that JAX can differentiate scores by the points and normals of a scan.

    **Raises:** `ValueError` if JAX cannot trace the acquisition (for example a utility in NumPy), or cannot
    differentiate it (because it calls code outside JAX).
    """
    if acquisition.needs_posterior or acquisition.needs_hypotheses:
        # This acquisition needs a posterior or hypotheses, which do not exist yet.
        return

    def cloud(rows: int) -> PointCloud:
        return PointCloud(jnp.zeros((rows, 3)), jnp.ones((rows, 3)), jnp.ones(rows, bool))

    def value(rows):
        points, normals = rows
        scan = PointCloud(points, normals, jnp.ones(camera.num_rays, bool))
        step = inputs_of(cloud(observations) if isinstance(observations, int) else observations)
        view = ImaginedView(scan, camera, Pose(jnp.eye(3), jnp.zeros(3)))
        return acquisition.score(acquisition.context(acquisition.inputs(step)), view)

    shape = jax.ShapeDtypeStruct((camera.num_rays, 3), jnp.result_type(float))
    with functions_of_users():
        jax.eval_shape(value, (shape, shape))
    if not differentiable:
        return
    try:
        jax.eval_shape(jax.grad(value), (shape, shape))
    except ValueError as error:
        raise InputError(
            f"{type(acquisition).__name__} cannot be differentiated, so no gradient search can use it ({error}). "
            "Use DiscreteSearch, which needs only values"
        ) from error
