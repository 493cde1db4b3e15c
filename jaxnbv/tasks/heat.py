"""Heat diffusion: where does a body that is heated at one place stay coldest?"""

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

# Longest edge, in scene units, of the triangles on which the true temperature is computed: within 2 % of that on ever
# finer ones at the default radius, in seconds.
_LONGEST_EDGE = 0.025
# Workers wait for the next candidates while the rest of a step is computed.
_IDLE_SECONDS = 120
# They import jaxnbv, and with it JAX, but leave the accelerator and each other's cores alone.
_WORKER_ENVIRONMENT = {"JAX_PLATFORMS": "cpu", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


class ColdestPoint(Utility):
    """The paper's u_H(D) = -min u^(T), a utility for `ExpectedUtilityImprovement`.

    Its Laplacian runs on the host, so it has no gradient: search over candidates, as in the paper. Values are equal to
    the last bit whatever the order of the points and the number of workers.

    - `heat`: the `HeatProblem`, or its source alone, (3,) in scene coordinates, with the authors' values for the rest.
      Scenes that differ in the source alone share one compilation.
    - `reached_only`: take the minimum over the points that the source can warm. The paper takes it over all, where it
      stays at u0, the least there can be, from the moment that D or an imagined scan has one piece that is not
      connected to the source: no view improves on that.
    - `workers`: processes that share the candidates, by default one a core; with 1, this process does the work.

    **Raises:** `ValueError` for less than one worker, as `HeatProblem` does, and when a gradient is asked for.
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
        # A list is converted on the way in, which mypy cannot see.
        self.heat = heat if isinstance(heat, HeatProblem) else HeatProblem(heat)  # type: ignore[arg-type]
        self.reached_only, self.workers = reached_only, workers

    def __call__(self, cloud: PointCloud) -> Float[Array, ""]:
        """u_H in degrees, of one cloud; under `vmap`, of all of them in one call.

        With no point to take the minimum over it is the least there can be, -(u0 + T power): any point improves on it.
        """
        source = jnp.asarray(self.heat.source, cloud.points.dtype)
        # The source is passed with each cloud: here it may be a value that JAX does not know yet.
        heat = replace(self.heat, source=np.zeros(3))
        values = partial(_values, heat=heat, reached_only=self.reached_only, workers=self.workers)
        return call_on_host(values, (), "ColdestPoint", cloud.points, cloud.mask, source)

    @property
    def improvement(self) -> Quantity:
        """What its expected improvement is."""
        meaning = "how much colder than now the coldest point is with an imagined scan, mean over posterior samples."
        return Quantity("expected fall of the least temperature", "degrees", meaning)

    def answer(self, cloud: PointCloud) -> "Coldest":
        """Where the cloud is coldest, and its temperature there."""
        return coldest_point(cloud, self.heat, self.reached_only)


def _values(
    points: np.ndarray, mask: np.ndarray, source: np.ndarray, heat: HeatProblem, reached_only: bool, workers: int
) -> list[float]:
    clouds = [rows[filled] for rows, filled in zip(points, mask, strict=True)]
    problems = [replace(heat, source=own) for own in source]
    return _map(partial(_value, reached_only=reached_only), clouds, problems, workers)


def _value(points: np.ndarray, heat: HeatProblem, reached_only: bool) -> float:
    temperature = cloud_temperature(points, heat)
    coldest = temperature.coldest(reached_only)
    return -(heat.highest if coldest is None else float(temperature.values[coldest]))


def _map(function: Callable, clouds: list, problems: list, workers: int) -> list[float]:
    # A worker of Dask's is a daemon, which Python lets start no processes.
    if workers == 1 or len(clouds) == 1 or multiprocessing.current_process().daemon:
        return list(map(function, clouds, problems))
    executor = optional("loky").get_reusable_executor(workers, timeout=_IDLE_SECONDS, env=_WORKER_ENVIRONMENT)
    return list(executor.map(function, clouds, problems, chunksize=math.ceil(len(clouds) / (4 * workers))))


def body_temperature(
    body: PointCloud | TriangleMesh, heat: HeatProblem
) -> tuple[Float[np.ndarray, "n 3"], Temperature]:
    """Points of a body, in scene coordinates, and their temperature: of a cloud its points; of a mesh its vertices,
    and as many more as it takes to resolve the heat.

    Of a mesh in separate parts, which may meet but share no vertices, only those with the source get warm; give a dense
    cloud of points of it where heat shall pass between parts that touch.
    """
    if isinstance(body, PointCloud):
        points = np.asarray(body.to_numpy()[0], np.float64)
        return points, cloud_temperature(points, heat)
    vertices, faces = refine(body.vertices, body.faces, _LONGEST_EDGE)
    return vertices, mesh_temperature(vertices, faces, heat)


class Coldest(Answer):
    """The coldest point (scene coordinates), and its temperature in degrees, which is the answer's one value.

    - `frame`: of the world in which the point is said.
    """

    point: Float[np.ndarray, "3"] = eqx.field(default_factory=lambda: np.zeros(3))
    frame: Frame = Frame()

    def in_world(self, frame: Frame) -> "Coldest":
        return replace(self, frame=frame)

    @property
    def temperature(self) -> float:
        return float(self.values[0])


@checked
def coldest_point(body: PointCloud | TriangleMesh, heat: HeatProblem, reached_only: bool = False) -> Coldest:
    """The coldest point of a cloud, which is the estimate, or of a mesh, which is the truth; the first of equals.

    - `reached_only`: as in `ColdestPoint`. Without it, where some points are not connected to the source, the answer is
      any one of them.

    **Raises:** `ValueError` if there is no point, or none that the source can warm.
    """
    points, temperature = body_temperature(body, heat)
    coldest = temperature.coldest(reached_only)
    if coldest is None:
        reason = f"none of its {len(points)} points is connected to the source" if len(points) else "it is empty"
        raise InputError(f"the body has no coldest point, as {reason}: scan the heat source first")
    return Coldest(("coldest",), temperature.values[[coldest]], point=points[coldest])
