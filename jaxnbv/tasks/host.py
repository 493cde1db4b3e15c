"""Functions that run outside JAX on the host, such as a PyTorch model or a solver. They have no derivative."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxnbv.checks import InputError, check_fields, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.tasks.classification import Classifier
from jaxnbv.tasks.segmentation import Segmenter


class HostClassifier(Classifier):
    """A classifier that runs outside JAX, for example a PyTorch model. Gradient searches cannot use it.

    - `function`: function that returns the log-probabilities (b, num_classes) of b clouds, given their points
      (b, n, 3), unit normals (b, n, 3) and mask (b, n) as NumPy arrays. b is at most 128.
    - `version`: a text or number, such as "2026-11", that you change whenever the function changes. A stored run needs
      a version, unless the function's source code and all variables that it reads can be described (see `describe`).
      The weights of a PyTorch model cannot.

    **Raises:** `ValueError` for an attempt to differentiate the classifier. If the function fails or returns an array
    of the wrong shape, JAX raises a `RuntimeError` whose text contains the original message.
    """

    function: Callable = eqx.field(static=True)
    num_classes: int = eqx.field(static=True)
    version: str | int | float | None = eqx.field(static=True, default=None, kw_only=True)
    batch_size: ClassVar[int] = 128

    def __check_init__(self):
        check_fields(self)
        require(self.num_classes >= 2, f"num_classes is {self.num_classes}; it must be at least 2")

    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """Return the log-probabilities of one cloud. Under `vmap`, the function gets all clouds in one call."""
        arrays = cloud.points, cloud.normals, cloud.mask
        return call_on_host(self.function, (self.num_classes,), "HostClassifier", *arrays)


class HostSegmenter(Segmenter):
    """A segmenter that runs outside JAX, for example a PyTorch model. Gradient searches cannot use it.

    - `function`: function that returns the part probabilities (b, n, num_parts), given the same arrays as in
      `HostClassifier`. Rows of the result for which the mask is False are ignored.
    - `version`: see `HostClassifier`.

    **Raises:** `ValueError` for an attempt to differentiate. If the function fails, JAX raises a `RuntimeError`.
    """

    function: Callable = eqx.field(static=True)
    num_parts: int = eqx.field(static=True)
    version: str | int | float | None = eqx.field(static=True, default=None, kw_only=True)
    batch_size: ClassVar[int] = 128

    def __check_init__(self):
        check_fields(self)
        require(self.num_parts >= 1, f"num_parts is {self.num_parts}; it must be at least 1")

    def __call__(self, cloud: PointCloud) -> Float[Array, "points parts"]:
        """Return the part probabilities of one cloud. Under `vmap`, the function gets all clouds in one call."""
        arrays = cloud.points, cloud.normals, cloud.mask
        p = call_on_host(self.function, (cloud.capacity, self.num_parts), "HostSegmenter", *arrays)
        return jnp.where(cloud.mask[:, None], p, 0.0)


@eqx.filter_custom_jvp
def call_on_host(
    function: Callable, shape: tuple[int, ...], name: str, *arrays: Shaped[Array, "..."]
) -> Float[Array, "..."]:
    """Call a NumPy function with JAX arrays, also under `jit` and `vmap`, and return the result.

    The function gets each array with one more leading axis, the batch of `vmap`, and returns a result with this axis.
    Outside `vmap`, the axis has length one.

    - `shape`: shape of the result without the leading axis. The result has the dtype of the first array.
    - `name`: name of the caller for error messages.

    **Raises:** `ValueError` for an attempt to differentiate the result.
    """
    num_axes, dtype = arrays[0].ndim, arrays[0].dtype

    def call(*inputs):
        batch = inputs[0].shape[: inputs[0].ndim - num_axes]
        flat = [np.asarray(array).reshape(-1, *array.shape[len(batch) :]) for array in inputs]
        result, expected = np.asarray(function(*flat), dtype), (len(flat[0]), *shape)
        require(result.shape == expected, f"the function of {name} returned shape {result.shape}, not {expected}")
        return result.reshape((*batch, *shape))

    return jax.pure_callback(call, jax.ShapeDtypeStruct(shape, dtype), *arrays, vmap_method="broadcast_all")


@call_on_host.def_jvp
def _call_on_host_jvp(primals, tangents):
    name = primals[2]
    raise InputError(f"{name} has no derivative, because it runs outside JAX: use DiscreteSearch, or write it in JAX")
