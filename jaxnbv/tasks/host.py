"""Functions that run outside JAX, on the host: a PyTorch model, a solver. They have no derivative, so a search over
candidates alone can use them."""

from collections.abc import Callable
from typing import Any, ClassVar

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
    """A classifier that runs outside JAX, a PyTorch model say: for search over candidates only.

    - `function`: from points (b, n, 3), unit normals (b, n, 3) and mask (b, n), as NumPy arrays, to log-probabilities
      (b, num_classes). It is called with up to 128 scans at once.
    - `num_classes`: how many classes it tells apart.
    - `version`: a text or number that you change whenever the function changes, "2026-11" say. A run that is stored
      needs it unless the function's source and all that it reads can be described, which weights of PyTorch cannot.

    **Raises:** `ValueError` when a gradient is asked for. A function that returns another shape, or fails, fails within
    JAX, which raises its own `RuntimeError` with the message in its text.
    """

    function: Callable = eqx.field(static=True)
    num_classes: int = eqx.field(static=True)
    version: str | int | float | None = eqx.field(static=True, default=None, kw_only=True)
    batch_size: ClassVar[int] = 128

    def __check_init__(self):
        check_fields(self)
        require(self.num_classes >= 2, f"num_classes is {self.num_classes}; a classifier tells at least two apart")

    def __call__(self, cloud: PointCloud) -> Float[Array, " classes"]:
        """Log-probabilities of one cloud; under `vmap`, of all of them in one call."""
        return _of_cloud(self.function, (self.num_classes,), "HostClassifier", cloud)


class HostSegmenter(Segmenter):
    """A segmenter that runs outside JAX, a PyTorch model say: for search over candidates only.

    - `function`: as of `HostClassifier`, to probabilities of the parts (b, n, num_parts); rows that the mask leaves out
      count for nothing, whatever it says of them.
    - `num_parts`: how many parts it tells apart.
    - `version`: as of `HostClassifier`.

    **Raises:** as `HostClassifier`.
    """

    function: Callable = eqx.field(static=True)
    num_parts: int = eqx.field(static=True)
    version: str | int | float | None = eqx.field(static=True, default=None, kw_only=True)
    batch_size: ClassVar[int] = 128

    def __check_init__(self):
        check_fields(self)
        require(self.num_parts >= 1, f"num_parts is {self.num_parts}; a segmenter knows one part at least")

    def __call__(self, cloud: PointCloud) -> Float[Array, "points parts"]:
        """Probabilities of the parts of one cloud's points; under `vmap`, of all clouds in one call."""
        p = _of_cloud(self.function, (cloud.capacity, self.num_parts), "HostSegmenter", cloud)
        return jnp.where(cloud.mask[:, None], p, 0.0)


def _of_cloud(function: Callable, shape: tuple[int, ...], name: str, cloud: PointCloud) -> Float[Array, "..."]:
    return call_on_host(function, shape, name, cloud.points, cloud.normals, cloud.mask)


def call_on_host(
    function: Callable, shape: tuple[int, ...], name: str, *arrays: Shaped[Array, "..."]
) -> Float[Array, "..."]:
    """A function of NumPy arrays with a leading axis more than here: of one entry or, under `vmap`, of all of them.

    - `shape`: of the result of one entry; it has the type of the first array.
    - `name`: of what is called, for errors.

    **Raises:** `ValueError` when it is differentiated.
    """
    return _call(arrays, function, shape, name)


@eqx.filter_custom_jvp
def _call(arrays: tuple[Any, ...], function: Callable, shape: tuple[int, ...], name: str) -> Float[Array, "..."]:
    own_axes, dtype = arrays[0].ndim, arrays[0].dtype

    def call(*given):
        batch = given[0].shape[: given[0].ndim - own_axes]
        flat = [np.asarray(array).reshape(-1, *array.shape[len(batch) :]) for array in given]
        found, expected = np.asarray(function(*flat), dtype), (len(flat[0]), *shape)
        require(found.shape == expected, f"the function of {name} returned shape {found.shape}, not {expected}")
        return found.reshape((*batch, *shape))

    return jax.pure_callback(call, jax.ShapeDtypeStruct(shape, dtype), *arrays, vmap_method="broadcast_all")


@_call.def_jvp
def _call_jvp(primals, tangents):
    *_, name = primals
    raise InputError(f"{name} has no derivative, as it runs outside JAX: use DiscreteSearch, or write it in JAX")
