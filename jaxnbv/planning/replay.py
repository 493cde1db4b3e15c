"""Runs that were stored, read without the planner that made them; sessions, planned again for another utility."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnbv.checks import InputError, checked, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.geometry.volume import Box
from jaxnbv.planning.episode import camera_of
from jaxnbv.planning.placing import stride_of
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.session import NextView, Session, check_camera
from jaxnbv.scanning import Surroundings
from jaxnbv.search import CandidateSearch, Proposal
from jaxnbv.storage import DepthImage, SessionFolder


class StoredSession:
    """The images of a session's folder and what is known of its sensor; not what its planner was.

    **Raises:** `ValueError` if the folder holds no session with an image.
    """

    @checked
    def __init__(self, folder: str | Path):
        self._folder = SessionFolder.open(folder)
        config = self._folder.config
        try:
            self.cameras = tuple(camera_of(camera) for camera in config["cameras"])
            require(config["box"].keys() - {"type"} == {"low", "high"}, "a box has a low and a high corner")
            self.box = Box(config["box"]["low"], config["box"]["high"])
            self.up, self.convention, self.stride = (config[name] for name in ("up", "convention", "stride"))
            # A session that was told what stands around it did not look for a table.
            told = config["planner"]["imagination"]["surroundings"] is not None
            self.surroundings = Surroundings() if told else None
            require(len(self.cameras) > 0, "no camera")
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            problem = f"{self._folder.record} does not say what the sensor was ({error!r})"
            raise InputError(f"{problem}: restore it, or give another folder") from error
        self.frame = Frame.fit(np.array([self.box.low, self.box.high]), up=self.up)
        self.views = self._folder.count_images()
        require(self.views > 0, f"{folder} holds no image yet: add one to the session first")

    def session(self, **settings: Any) -> Session:
        """A new session at the same sensor, with other settings of `Session`."""
        sensor = {"up": self.up, "convention": self.convention, "stride": self.stride}
        return Session(self.cameras, self.box, surroundings=self.surroundings, **sensor, **settings)

    def image(self, index: int) -> DepthImage:
        """The image of an index, from 0.

        **Raises:** `ValueError` if it is damaged, or of a camera that the session has not.
        """
        image = self._folder.read_image(index)
        check_camera(image.camera, len(self.cameras))
        return image

    def first_view(self) -> tuple[Pose, PointCloud]:
        """Pose and scan of the first image, in scene coordinates."""
        image = self.image(0)
        pose = Pose.from_matrix(image.matrix, self.convention)
        camera = self.cameras[image.camera]
        stride = stride_of(camera) if self.stride is None else self.stride
        cloud = PointCloud.from_depth(image.depth, camera, pose, image.depth_scale, stride, self.box)
        return self.frame.to_scene(pose), self.frame.to_scene(cloud)

    def proposal(self, index: int) -> tuple[Proposal, Float[np.ndarray, "h w"] | None] | None:
        """The session's own proposal for the image of an index, and the depth that was expected of it; None where it
        was not asked for."""
        return self._folder.read_proposal(index)

    def candidates(self) -> Float[np.ndarray, "n 4 4"] | None:
        """The poses that the session's own planner chose among, in world units; None where it has proposed nothing."""
        for index in range(self.views + 1):
            if (known := self.proposal(index)) is not None:
                return np.asarray(self.frame.to_world(known[0].candidates).to_matrix(self.convention))
        return None

    def replay(self, planner: Planner, out: str | Path | None = None) -> Iterator[tuple[Session, NextView]]:
        """After each image, the session so far and where this planner would have taken the next one.

        - `planner`: see `Session`; a search over candidates is given those that the session's own planner had, where
          they are known.
        - `out`: a folder for the session that results; images are copied there. What was interrupted goes on after the
          last of them.

        **Raises:** `ValueError` as `Session` and its `add` and `next` do.
        """
        require(
            out is None or Path(out).resolve() != self._folder.path.resolve(),
            f"{out} holds the session that is to be replayed: choose another folder",
        )
        poses = self.candidates() if isinstance(planner.search, CandidateSearch) else None
        session = self.session(planner=planner, poses=poses, folder=out)
        # What was killed may lack the answer to its last image.
        if session.views:
            yield session, session.next()
        for index in range(session.views, self.views):
            session.add(*self.image(index))
            yield session, session.next()
