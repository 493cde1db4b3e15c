"""The box of a session, and the conversion of the session's planner to scene coordinates."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import as_numbers, require, short_text
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.planner import Planner
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Obstacles
from jaxnbv.search import DiscreteSearch
from jaxnbv.tasks import NewSurface

# Default number of posterior samples. Twice as many did not give better views on recordings.
_SAMPLES = 8


def usual_planner() -> Planner:
    """Return the default planner of a session."""
    return Planner(
        NewSurface(), DiscreteSearch(), Camera(height=24, width=32), SurfaceSampler(num_samples=_SAMPLES), capacity=2000
    )


def box_of(corners) -> Box:
    """Convert two corners, or a `Box`, to a `Box`. **Raises:** `ValueError` for anything else."""
    if isinstance(corners, Box):
        return corners
    require(np.shape(corners) == (2, 3), f"the box is {short_text(corners)}; give two corners, (low, high), or a Box")
    return Box(*(as_numbers(corner, "a corner of the box", np.float64) for corner in corners))


def in_scene(
    planner: Planner,
    camera: Camera,
    box: Box,
    frame: Frame,
    convention: str,
    matrices: Float[np.ndarray, "n 4 4"] | None,
    obstacles: Obstacles | None,
) -> Planner:
    """Return a copy of a planner for a sensor and a box, in scene coordinates.

    The arguments are those of `Session`, in world units. `matrices` are the poses. If `matrices` is None, the planner's
    own candidates are used, and only the upper half of a sphere. If `obstacles` is None, the planner's own are used.
    """
    search = planner.search.upper_half()
    if matrices is not None:
        search = planner.search.over(frame.to_scene(Pose.from_matrix(matrices, convention)))
    sampler = planner.sampler.within(frame.to_scene(box))
    return dataclasses.replace(
        planner,
        search=search,
        camera=frame.to_scene(camera).resized(planner.camera.height, planner.camera.width),
        sampler=dataclasses.replace(sampler, model=sampler.model.in_scene(frame)),
        cost=None if planner.cost is None else planner.cost.in_world(frame),
        obstacles=planner.obstacles if obstacles is None else obstacles.in_scene(frame),
    )
