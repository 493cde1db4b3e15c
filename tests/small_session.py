"""A simulated sensor of 64 x 48 pixels in millimetres, and a world in metres with z up and a table in view."""

import numpy as np

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose, look_at
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.session import Session
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, Obstacles, SDFSurface, scan
from jaxnbv.scanning.sdf import Cuboid, Sphere
from jaxnbv.search import DiscreteSearch
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

CENTER = np.array([0.3, 0.2, 0.12])
WORLD = SDFSurface(Sphere(0.1).translate([0.3, 0.2, 0.101]) | Cuboid([1.0, 1.0, 0.02]).translate([0.3, 0.2, -0.021]))
CAMERA = Camera.from_intrinsics([[90.0, 0.0, 34.0], [0.0, 95.0, 21.5], [0.0, 0.0, 1.0]], width=64, height=48)
BOX = ((0.18, 0.08, 0.002), (0.42, 0.32, 0.24))


def around(angle, elevation, distance=0.6):
    direction = [np.cos(angle) * np.cos(elevation), np.sin(angle) * np.cos(elevation), np.sin(elevation)]
    return np.asarray(look_at(CENTER + distance * np.array(direction), CENTER, up=(0.0, 0.0, 1.0)).matrix, np.float64)


POSES = np.array([around(angle, e) for e in (0.4, 0.9) for angle in np.arange(0.0, 6.2, np.pi / 3)])
FIRST = around(0.2, 0.5)


def shot(matrix, unit=1000.0):
    """A depth image in whole millimetres, zero without a hit. A pixel in a corner flickers, so that images of a round
    object from different sides differ."""
    pose = Pose.from_matrix(matrix)
    cloud = scan(WORLD, CAMERA, pose)
    depth = (np.asarray(cloud.points, np.float64) - np.asarray(pose.position)) @ np.asarray(pose.forward, np.float64)
    image = np.where(cloud.mask, unit * depth, 0.0).reshape(48, 64)
    image[0, 0] = unit * 0.001 * (1 + int(1e4 * np.abs(matrix).sum()) % 97)
    return np.round(image).astype(np.uint16) if unit > 1 else image


def planner_of(search=DiscreteSearch(), num_samples=3, capacity=400):  # noqa: B008
    sampler = SurfaceSampler(GeometricSPSR(0.2, truncation=8), Grid(28), num_samples)
    return Planner(Coverage(), search, Camera(height=12, width=16), sampler, capacity=capacity, max_views=8)


def session_of(folder=None, **changes):
    defaults = {"obstacles": Obstacles(), "poses": POSES, "folder": folder}
    settings = {"camera": CAMERA, "box": BOX, "up": "z", **defaults, **changes}
    return Session(**{"planner": planner_of(), **settings})


def begun(folder=None, **changes):
    """A session after its first image."""
    session = session_of(folder, **changes)
    session.add(shot(FIRST), FIRST, depth_scale=1e-3)
    return session
