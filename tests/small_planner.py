"""A planner whose programs are small, with a scene and a first view for it; alike in many tests, which then share what
was compiled."""

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import look_at
from jaxnbv.imagination import Imagination
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface
from jaxnbv.scanning.sdf import Capsule, Sphere
from jaxnbv.search import DiscreteSearch
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

SOLID = Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.3)
SCENE, FIRST = SDFSurface(SOLID), look_at((0.8, 0.9, 2.2))
MODEL, CAMERA = GeometricSPSR(truncation=8, lengthscale=0.05), Camera(height=8, width=8)


def planner_of(search=DiscreteSearch(12), score=Coverage(), num_samples=3, cost=None, **changes):  # noqa: B008
    imagination = Imagination(MODEL, Grid(24), num_samples)
    return Planner(score, search, CAMERA, imagination, cost, **{"capacity": 128, "max_views": 6, **changes})
