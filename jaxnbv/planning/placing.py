"""A planner at a real sensor: what it is given of the sensor, the box and what the object stands on."""

import dataclasses
import math
import warnings

import numpy as np

from jaxnbv.checks import InputError, as_numbers, require, shown
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Obstacles
from jaxnbv.scanning.sdf import HalfSpace
from jaxnbv.search import CandidateSearch, GivenPoses, HalvingSearch, SphereCandidates
from jaxnbv.tasks import NewSurface

# A cloud holds some thousands of points; more rays than these only take time.
_MOST_RAYS = 20_000


def usual_planner() -> Planner:
    """What a session plans by where nothing else is given."""
    return Planner(NewSurface(), HalvingSearch(), Camera(height=24, width=32), capacity=2000)


def box_of(corners) -> Box:
    """**Raises:** `ValueError` for what is neither a `Box` nor two corners."""
    if isinstance(corners, Box):
        return corners
    require(np.shape(corners) == (2, 3), f"the box is {shown(corners)}; give two corners, (low, high), or a Box")
    return Box(*(as_numbers(corner, "a corner of the box", np.float64).tolist() for corner in corners))


def stride_of(camera: Camera) -> int:
    """The stride that leaves as many rays of an image as are worth their time."""
    return math.ceil(math.sqrt(camera.num_rays / _MOST_RAYS))


def placed(planner: Planner, camera: Camera, box: Box, poses: Pose | None, obstacles: Obstacles | None) -> Planner:
    """A planner at a sensor, all in scene coordinates: see `Session`.

    - `poses`: where the search may look from, or None for its own candidates.

    **Raises:** `ValueError` if the search does not choose among poses.
    """
    sampler, search = planner.sampler.within(box), planner.search
    if obstacles is not None:
        sampler = dataclasses.replace(sampler, obstacles=obstacles)
    if poses is not None:
        if not isinstance(search, CandidateSearch):
            raise InputError(
                f"the session was given poses, but {type(search).__name__} is no search over candidates: use "
                "DiscreteSearch() or HalvingSearch()"
            )
        search = dataclasses.replace(search, candidates=GivenPoses(poses))
    elif isinstance(search, CandidateSearch) and isinstance(search.candidates, SphereCandidates):
        search = dataclasses.replace(search, candidates=search.candidates.upper_half)
    camera = camera.resized(planner.camera.height, planner.camera.width)
    return dataclasses.replace(planner, camera=camera, search=search, sampler=sampler)


def on_support(planner: Planner, plane: HalfSpace | None, frame: Frame) -> Planner:
    """The planner with the plane that the object stands on among its obstacles, told of by a warning in world units;
    with obstacles that hold nothing but the points that were seen, if there is none."""
    if plane is not None:
        place = np.round(frame.to_world(np.asarray(plane.point, np.float64)), 4).tolist()
        warnings.warn(
            f"the object stands on a plane through {place}, which goes on beyond the box: it is taken for a table and "
            "left out. Give obstacles=Obstacles() to keep it",
            stacklevel=5,
        )
    around = Obstacles(() if plane is None else (plane,))
    return dataclasses.replace(planner, sampler=dataclasses.replace(planner.sampler, obstacles=around))
