"""A small episode, run into a folder."""

from pathlib import Path

import jax

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import look_at
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import simulate
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise
from jaxnbv.scanning.sdf import Capsule, Sphere
from jaxnbv.search import DiscreteSearch
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

SCENE = SDFSurface(Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.3))
FIRST = look_at((0.8, 0.9, 2.2))
KEY = jax.random.key(0)


def planner_of(search=None, lengthscale=0.05, **changes):
    search = DiscreteSearch(12) if search is None else search
    model, camera = GeometricSPSR(truncation=8, lengthscale=lengthscale), Camera(height=8, width=8)
    imagined = {name: changes.pop(name, usual) for name, usual in {"num_samples": 3, "grid": Grid(24)}.items()}
    settings = {"capacity": 128, "max_views": 6, **changes}
    return Planner(Coverage(), search, camera, Imagination(model, **imagined), **settings)


BASE = {"planner": planner_of(), "scene": SCENE, "noise": SensorNoise(), "first": FIRST, "key": KEY}


def run(folder, views=3, **changes):
    return simulate(**(BASE | changes), views=views, folder=folder, progress=False)


def contents(folder):
    """Of all files but the lock."""
    return {file.name: file.read_bytes() for file in sorted(Path(folder).iterdir()) if file.name != ".lock"}
