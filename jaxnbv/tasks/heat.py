"""Heat diffusion: which point of a body is coldest if the body is heated in one place?"""

import math
import multiprocessing
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnbv.checks import AnyArray, InputError, checked, require
from jaxnbv.errors import optional
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.scanning import TriangleMesh
from jaxnbv.tasks.diffusion import HeatProblem, Temperature, cloud_temperature, mesh_temperature, refine
from jaxnbv.tasks.host import call_on_host
from jaxnbv.utility import Answer, Quantity, Utility

# Longest edge of the triangles for the true temperature, in scene units. At the default radius, the temperature differs
# by at most 2 % from its limit for fine triangles, and the computation takes seconds.
_LONGEST_EDGE = 0.025
# Idle time after which a worker exits. It must be longer than the time between two calls.
_IDLE_SECONDS = 120
# Workers import JAX, but must not occupy the accelerator or use more than one core each.
_WORKER_ENVIRONMENT = {"JAX_PLATFORMS": "cpu", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


class ColdestPoint(Utility):
    """Negative lowest temperature, u_H(D) = -min u^(T), a utility for `ExpectedUtilityImprovement`.

    This is the paper's u_H. u^(T) are the temperatures of the points of the cloud D after a time T of heating. The heat
    equation is solved outside JAX, so there is no gradient. Use a search over candidates, as in the paper. The values
    do not depend on the order of the points or the number of workers, not even in the last bit.

    - `heat`: a `HeatProblem`, or only its source (3,) in scene coordinates, with the authors' values for the rest.
      Problems that differ only in the source share one compiled program.
    - `reached_only`: take the minimum only over points that are connected to a heated point. By default it is taken
      over all points, as in the paper. One point that is not connected to the source then keeps the minimum at the
      initial temperature, and no view can improve it.
    - `workers`: number of processes that share the clouds, by default one for each core. With 1, this process does all.

    **Raises:** `ValueError` for fewer than one worker, an invalid source, or an attempt to differentiate the utility.
    """

    heat: HeatProblem
    reached_only: bool = eqx.field(static=True)
    workers: int = eqx.field(static=True)
    batch_size: ClassVar[int] = 128

    @checked
    def __init__(
        self,
        heat: HeatProblem | Float[AnyArray, "3"] | Sequence[float],
        reached_only: bool = False,
        workers: int | None = None,
    ):
        workers = optional("loky").cpu_count() if workers is None else workers
        require(workers >= 1, f"the number of workers is {workers}; it must be at least 1")
        # `HeatProblem` converts a list, which mypy cannot see.
        self.heat = heat if isinstance(heat, HeatProblem) else HeatProblem(heat)  # type: ignore[arg-type]
        self.reached_only, self.workers = reached_only, workers

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """Return the negative lowest temperature of one cloud, in degrees.

        Under `vmap`, one call on the host computes all clouds. If there is no point to take the minimum over,
        `HeatProblem.highest` takes its place, so that any point of a later scan improves the utility.
        """
        source = jnp.asarray(self.heat.source, cloud.points.dtype)
        # The source may be traced, so it is passed as an array together with the cloud.
        heat = replace(self.heat, source=np.zeros(3))
        values = partial(_values, heat=heat, reached_only=self.reached_only, workers=self.workers)
        return call_on_host(values, (), "ColdestPoint", cloud.points, cloud.mask, source)

    @property
    def improvement(self) -> Quantity:
        meaning = "how much colder than now the coldest point is with an imagined scan, mean over posterior samples."
        return Quantity("expected fall of the least temperature", "degrees", meaning)

    def answer(self, cloud: PointCloud) -> "Coldest":
        """Return the coldest point of the cloud and its temperature."""
        return coldest_point(cloud, self.heat, self.reached_only)


def _values(
    points: np.ndarray, mask: np.ndarray, source: np.ndarray, heat: HeatProblem, reached_only: bool, workers: int
) -> list[float]:
    clouds = [rows[is_filled] for rows, is_filled in zip(points, mask, strict=True)]
    problems = [replace(heat, source=center) for center in source]
    return _map(partial(_value, reached_only=reached_only), clouds, problems, workers)


def _value(points: np.ndarray, heat: HeatProblem, reached_only: bool) -> float:
    temperature = cloud_temperature(points, heat)
    coldest = temperature.coldest(reached_only)
    return -(heat.highest if coldest is None else float(temperature.values[coldest]))


def _map(function: Callable, clouds: list, problems: list, workers: int) -> list[float]:
    # Python does not let daemon processes, such as Dask workers, start processes.
    if workers == 1 or len(clouds) == 1 or multiprocessing.current_process().daemon:
        return list(map(function, clouds, problems))
    executor = optional("loky").get_reusable_executor(workers, timeout=_IDLE_SECONDS, env=_WORKER_ENVIRONMENT)
    return list(executor.map(function, clouds, problems, chunksize=math.ceil(len(clouds) / (4 * workers))))


def body_temperature(
    body: PointCloud | TriangleMesh, heat: HeatProblem
) -> tuple[Float[np.ndarray, "n 3"], Temperature]:
    """Return points of a body, in scene coordinates, and the temperature at these points.

    For a mesh, the points are the vertices after refinement, which is fine enough for the default heat problem. If two
    components touch but share no vertices, heat flows between them in a dense cloud, but not in a mesh.
    """
    if isinstance(body, PointCloud):
        points = np.asarray(body.to_numpy()[0], np.float64)
        return points, cloud_temperature(points, heat)
    vertices, faces = refine(body.vertices, body.faces, _LONGEST_EDGE)
    return vertices, mesh_temperature(vertices, faces, heat)


class Coldest(Answer):
    """The coldest point of a body. The answer's only value is the temperature there, in degrees.

    - `point`: the coldest point, in scene coordinates.
    - `frame`: frame of the world coordinates in which the text of the answer gives the point.
    """

    point: Float[np.ndarray, "3"] = eqx.field(default_factory=lambda: np.zeros(3))
    frame: Frame = Frame()

    def in_world(self, frame: Frame) -> "Coldest":
        return replace(self, frame=frame)

    @property
    def temperature(self) -> float:
        """Temperature of the point in degrees."""
        return float(self.values[0])


@checked
def coldest_point(body: PointCloud | TriangleMesh, heat: HeatProblem, reached_only: bool = False) -> Coldest:
    """Return the coldest point of a cloud or a mesh, the first if several are equally cold.

    - `reached_only`: see `ColdestPoint`.

    **Raises:** `ValueError` if there is no point or, with `reached_only`, no point that is connected to the source.
    """
    points, temperature = body_temperature(body, heat)
    coldest = temperature.coldest(reached_only)
    if coldest is None:
        reason = f"none of its {len(points)} points is connected to the source" if len(points) else "it is empty"
        raise InputError(f"the body has no coldest point, because {reason}: scan the heat source first")
    return Coldest(("coldest",), temperature.values[[coldest]], point=points[coldest])
