"""The folder of a session: its images, its proposals and what was refused, each stored before it is acted on."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxnbv.checks import require
from jaxnbv.planning.images import Image
from jaxnbv.planning.reachability import Refused
from jaxnbv.search import Proposal
from jaxnbv.storage import RunFolder

_KIND = "session"


class SessionFolder:
    """What a session stores, in the order in which it happened.

    - `path`: the folder; `config`: what the session is made of, as it was given.

    **Raises:** `ValueError` for a folder of another session.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        self._folder = RunFolder(path, _KIND, config)

    @staticmethod
    def config_of(path: str | Path, **known: Any) -> dict[str, Any]:
        """What the session of a folder is made of; `known` takes the place of what cannot be read.

        **Raises:** `ValueError` if the folder holds no session.
        """
        return RunFolder.config_of(path, _KIND, **known)

    @contextmanager
    def writing(self, num_images: int) -> Iterator[None]:
        """While nobody else writes there. `num_images`: how many images the session knows.

        **Raises:** `ValueError` if another process writes there, or has added images.
        """
        with self._folder.writing():
            require(
                self.num_images == num_images,
                f"{self._folder.path} holds {self.num_images} images, but this session knows {num_images}: another "
                "process has added some; make the session again, which reads them",
            )
            yield

    @property
    def num_images(self) -> int:
        """How many images are stored."""
        return self._folder.count("image")

    def image(self, index: int) -> Image:
        """The image of a number, from 0 on."""
        stored = self._folder.read("image", index)
        image = Image.of(stored["depth"], stored["matrix"], float(stored["depth_scale"]), stored.get("mask"))
        return image._replace(robot=stored.get("robot"))

    def store_image(self, index: int, image: Image) -> None:
        """Store an image. A proposal that was planned from images which were deleted since goes."""
        self._folder.file("proposal", index + 1).unlink(missing_ok=True)
        pixels = {"mask": image.mask, "robot": image.robot}
        pixels = {name: rows for name, rows in pixels.items() if rows is not None}
        self._folder.write("image", index, depth=image.depth, matrix=image.matrix, depth_scale=image.scale, **pixels)

    def proposal(self, num_images: int) -> Proposal | None:
        """What was proposed after so many images; None for nothing."""
        if not self._folder.file("proposal", num_images).exists():
            return None
        return self._folder.read("proposal", num_images)["proposal"]

    def store_proposal(self, num_images: int, proposal: Proposal) -> None:
        """Store what is proposed after so many images."""
        self._folder.write("proposal", num_images, proposal=proposal)

    def refused(self) -> list[Refused]:
        """Poses that were refused."""
        stored = [self._folder.read("refused", index) for index in range(self._folder.count("refused"))]
        return [Refused(one["pose"], str(one["reason"])) for one in stored]

    def store_refused(self, num_images: int, refused: Refused) -> None:
        """Store that the proposal after so many images is refused, which is no proposal any more."""
        index = self._folder.count("refused")
        self._folder.write("refused", index, pose=refused.pose, reason=np.asarray(refused.reason))
        self._folder.file("proposal", num_images).unlink(missing_ok=True)
