"""A planner with small programs, a scene and a first view. Many tests share them, and so share compiled programs."""

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Capsule, Sphere

SOLID = Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.3)
SCENE, FIRST = nbv.SDFSurface(SOLID), nbv.look_at((0.8, 0.9, 2.2))
MODEL, CAMERA = nbv.GeometricSPSR(truncation=8, lengthscale=0.05), nbv.Camera(height=8, width=8)


def planner_of(
    search=nbv.DiscreteSearch(12),  # noqa: B008
    score=nbv.Coverage(),  # noqa: B008
    num_samples=3,
    cost=None,
    model=MODEL,
    grid=nbv.Grid(24),  # noqa: B008
    **changes,
):
    sampler = nbv.SurfaceSampler(model, grid, num_samples)
    return nbv.Planner(score, search, CAMERA, sampler, cost, **{"capacity": 128, "max_views": 6, **changes})
