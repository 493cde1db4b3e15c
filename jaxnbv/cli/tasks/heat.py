"""The task that asks for the coldest point of an object that is heated at one position."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import jaxnbv as nbv
from jaxnbv.cli.options import Position, task_option
from jaxnbv.cli.tasks.base import Subject, Task

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from jaxnbv.scanning.sensors import Setting

_NUM_POINTS = 2048


@dataclass(frozen=True, kw_only=True)
class HeatTask(Task):
    name = "heat"
    about = "its coldest point when it is heated"
    example = "a procedural body of one of four kinds, heated at one place"
    source: Annotated[
        Position | None,
        task_option(
            metavar="X Y Z",
            help="For heat: position in scene units. The object is heated at its point nearest to it.",
            show_default="the middle of the first view",
        ),
    ] = None

    @classmethod
    def setting(cls) -> "Setting":
        from jaxnbv.studies.sensors import HEAT_SETTING

        return HEAT_SETTING

    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        return _coldest_acquisition(_source(self.source, mesh, camera, first))

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        import jax
        import numpy as np

        from jaxnbv.studies.scenes import heat_scene, source_view

        heat_object = heat_scene(scene)
        first = source_view(heat_object, jax.random.key(seed))
        acquisition = _coldest_acquisition(np.asarray(heat_object.source))
        return Subject(heat_object.name, heat_object.surface, acquisition, first, bank="heat")


def _coldest_acquisition(source: "Float[np.ndarray, '3']") -> "nbv.Acquisition":
    return nbv.ExpectedUtilityImprovement(nbv.ColdestPoint(source), _NUM_POINTS)


def _source(
    position: Position | None, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose"
) -> "Float[np.ndarray, '3']":
    """Return the object's point nearest to `position`; if that is None, the point in the middle of the first view."""
    import jax
    import numpy as np

    from jaxnbv.checks import require

    if position is not None:
        points = mesh.sample_points(jax.random.key(0), 20_000)
        return points[np.linalg.norm(points - position, axis=1).argmin()]
    points, _ = nbv.scan(mesh, camera, first).to_numpy()
    require(len(points) > 0, "the first view does not see the object: give another --first, or a --source")
    offsets, forward = points - np.asarray(first.position), np.asarray(first.forward)
    distances = np.linalg.norm(offsets - (offsets @ forward)[:, None] * forward, axis=1)
    return points[distances.argmin()]
