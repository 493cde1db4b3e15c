"""A minimal study."""

from typing import ClassVar

from jaxnbv.scanning import SDFSurface
from jaxnbv.scanning.sdf import Sphere
from jaxnbv.studies.engine.measures import Claim, Measure
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.tasks import Coverage


class ToyStudy(Study):
    """Number of points seen of a ball."""

    title: ClassVar[str] = "Points of a ball"
    explanation: ClassVar[str] = "More is better."
    methods: ClassVar[tuple[str, ...]] = ("farthest", "random")
    reference: ClassVar[str] = "farthest"
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure("points", "Points", lambda r, m: r["methods"][m]["points"], digits=1),
        Measure("many", "Many points", lambda r, m: [float(n > 3000) for n in r["methods"][m]["points"]], unit="%"),
        Measure("odd", "Odd ones", lambda r, m: {"once": r["methods"][m].get("odd")}, "time"),
    )
    claims: ClassVar[tuple[Claim, ...]] = (Claim("Far apart | more is seen.", "points", 2, ("random", "absent")),)
    seed: ClassVar[int] = 11

    @classmethod
    def group(cls, record):
        return "odd" if record["scene"] % 2 else "even"

    def scene(self, index):
        return Scene(index, f"ball {index}", SDFSurface(Sphere(1.0)))

    def acquisition(self, method, scene):
        return Coverage()

    def follow(self, scene, truth, planner, episode):
        return {"points": [int(view.cloud.count) for view, *_ in episode]}
