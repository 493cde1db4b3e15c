"""The folder of a session, which stores images, proposals and refused poses before they are used."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxnbv.checks import require
from jaxnbv.planning.images import Image
from jaxnbv.planning.reachability import RefusedPose
from jaxnbv.search import Proposal
from jaxnbv.storage import RunFolder

KIND = "session"


class SessionFolder:
    """The stored images, proposals and refused poses of a session, in order.

    **Raises:** `ValueError` if the folder belongs to a session with a different `config`, the arguments of the session.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        self._folder = RunFolder(path, KIND, config)

    @contextmanager
    def writing(self, num_images: int) -> "Iterator[SessionFolder]":
        """Context manager: lock the folder for writing, and yield it.

        - `num_images`: number of images that the session has.

        **Raises:** `ValueError` if a different process writes to the folder or has added images.
        """
        with self._folder.writing():
            require(
                self.num_images == num_images,
                f"{self._folder.path} holds {self.num_images} images, but this session knows {num_images}: another "
                "process has added some; make the session again to read them",
            )
            yield self

    @property
    def num_images(self) -> int:
        """Number of stored images."""
        return self._folder.count("image")

    def image(self, index: int) -> Image:
        """Read the image with this index, counted from 0."""
        entry = self._folder.read("image", index)
        image = Image.from_arrays(entry["depth"], entry["matrix"], float(entry["depth_scale"]), entry.get("mask"))
        return image._replace(robot=entry.get("robot"))

    def store_image(self, index: int, image: Image) -> None:
        """Store an image, and delete a stored proposal for the image after it.

        Such a proposal exists only if the user has deleted the folder's last images, from which it was computed.
        """
        self._folder.file("proposal", index + 1).unlink(missing_ok=True)
        pixels = {"mask": image.mask, "robot": image.robot}
        pixels = {name: rows for name, rows in pixels.items() if rows is not None}
        self._folder.write("image", index, depth=image.depth, matrix=image.matrix, depth_scale=image.scale, **pixels)

    def proposal(self, num_images: int) -> Proposal | None:
        """Read the proposal that was made after `num_images` images; None if none is stored."""
        if not self._folder.file("proposal", num_images).exists():
            return None
        return self._folder.read("proposal", num_images)["proposal"]

    def store_proposal(self, num_images: int, proposal: Proposal) -> None:
        """Store the proposal that was made after `num_images` images."""
        self._folder.write("proposal", num_images, proposal=proposal)

    def refused_poses(self) -> list[RefusedPose]:
        """Read all refused poses."""
        entries = [self._folder.read("refused", index) for index in range(self._folder.count("refused"))]
        return [RefusedPose(entry["pose"], str(entry["reason"])) for entry in entries]

    def store_refused_pose(self, num_images: int, refused: RefusedPose) -> None:
        """Store a refused pose, and remove the proposal that was made after `num_images` images."""
        index = self._folder.count("refused")
        self._folder.write("refused", index, pose=refused.pose, reason=np.asarray(refused.reason))
        self._folder.file("proposal", num_images).unlink(missing_ok=True)
