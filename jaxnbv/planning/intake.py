"""Conversion of a session's images to views, with detection of the table, clutter and pose errors."""

import copy
import dataclasses
import warnings
from collections.abc import Callable

import numpy as np

from jaxnbv.checks import InputError, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.depth_image import NothingInside
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.clutter import Clutter
from jaxnbv.planning.images import Image, only_where, stride_of
from jaxnbv.planning.loop import Loop
from jaxnbv.planning.mount import MountError
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.table import other_ups, table_under
from jaxnbv.scanning import Obstacles


class Intake:
    """The images of a session so far, and the table, clutter and pose errors detected in the images.

    - `camera`, `box`, `frame`, `convention`: as in the session, in world units.
    - `planner`: planner in scene coordinates. If the planner's `obstacles` is None, the first image is searched for a
      table, and all images for clutter.
    """

    def __init__(self, camera: Camera, box: Box, frame: Frame, convention: str, planner: Planner):
        self.camera, self.box, self.frame, self.convention, self.planner = camera, box, frame, convention, planner
        self.stride = stride_of(camera)
        self.images: tuple[Image, ...] = ()
        self.mount_error = MountError(camera, convention)
        self.table: Obstacles | None = None
        # If no table is detected with the session's upward axis, the other axes with which one would be.
        self.other_ups: tuple[str, ...] = ()
        self.clutter = self._no_clutter()

    def without_images(self) -> "Intake":
        """Return a copy that has no images but keeps the pose corrections, so that images can be added again."""
        intake = copy.copy(self)
        intake.images, intake.clutter = (), self._no_clutter()
        return intake

    def add(self, loop: Loop, image: Image, on_accept: Callable[[], None] = lambda: None) -> Loop | None:
        """Add an image to the loop as a view, and return the loop, or None if the image is blank.

        - `on_accept`: function that is called after all checks and before the view is added.

        **Raises:** `ValueError` as in `Session.add`, also for a blank first image. Intake and loop then stay unchanged.
        """
        index = len(self.images)
        image.check_not_stale(self.images)
        pose = self.mount_error.pose(image, index)
        clean = image.without_sentinels(self.camera, pose, self.box)
        cloud = self._cloud(clean, pose, is_first=index == 0)
        if index > 0 and image.is_blank(cloud):
            return None
        table, ups = self.table, self.other_ups
        if index == 0 and self.planner.obstacles is None:
            full_cloud = clean.cloud(self.camera, pose, self.stride)
            table = table_under(self.frame.to_scene(full_cloud), self.frame.to_scene(self.box))
            ups = other_ups(full_cloud, self.box, self.frame.up) if table is None else ()
            # Obstacles without a solid still keep cameras clear of the points of D.
            loop = loop.without_views(dataclasses.replace(self.planner, obstacles=table or Obstacles()))
        if image.mask is not None:
            cloud = only_where(cloud, image.mask, self.camera, self.stride)
        if image.robot is not None or image.mask is not None:
            shows_any = index > 0 or bool(cloud.mask.any())
            require(shows_any, "the first image shows nothing of the box at the pixels of the mask, or all is ignored")
        obstacles, scan = loop.planner.obstacles, self.frame.to_scene(cloud)
        loop.add(self.frame.to_scene(pose), scan if obstacles is None else obstacles.remove_points(scan), on_accept)
        if self.clutter is not None and obstacles is not None:
            self.clutter = self.clutter.with_image(clean, self.camera, pose, self.frame, obstacles)
            loop = loop.with_clutter(self.clutter.solid())
        self.mount_error.add(clean, index)
        self.images, self.table, self.other_ups = (*self.images, image), table, ups
        return loop

    def _cloud(self, image: Image, pose: Pose, is_first: bool) -> PointCloud:
        """Return the points of an image in the box, and in the margin around it that carving needs."""
        region, sampler = self.box, self.planner.sampler
        if sampler.carving is not None:
            region = sampler.carving.with_room(region, sampler.grid, self.frame)
        with warnings.catch_warnings():
            if is_first:
                warnings.simplefilter("error", NothingInside)
            try:
                return image.cloud(self.camera, pose, self.stride, region)
            except NothingInside as problem:
                raise InputError(f"the first image shows nothing of the box: {problem}") from problem

    def _no_clutter(self) -> Clutter | None:
        """Return clutter without votes; None if the user passed obstacles."""
        if self.planner.obstacles is not None:
            return None
        max_coordinate = float(np.abs(np.asarray(self.planner.search.poses_around().position)).max())
        return Clutter.empty(max_coordinate + float(Obstacles().clearance), self.frame.to_scene(self.box))
