"""A live session on disk, written image by image.

session.json      the configuration (planner, sensor, box, what is up) and the versions that made it
image_00.npz      the first depth image as the sensor gave it, its pose and scale; image_01.npz and so on
proposal_01.npz   where the planner wanted the image of that number to be taken; its candidates and their values
"""

import os
import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Real

from jaxnbv.checks import require
from jaxnbv.search import Proposal
from jaxnbv.storage.arrays import POSE, PROPOSAL, ArrayFile, arrays_of, proposal_of
from jaxnbv.storage.folders import ResultFolder

_IMAGE = ArrayFile("image", ("depth", "matrix", "depth_scale"), "restore it, or delete it and those after it")
_PROPOSAL = ArrayFile("proposal", (*POSE, *PROPOSAL, "expected_depth"), "delete it, and it is asked for again")


class DepthImage(NamedTuple):
    """What a sensor gave.

    - `depth`: along the forward axis; `depth_scale` times it is in world units.
    - `matrix`: camera to world, in the convention of the session.
    """

    depth: Real[np.ndarray, "h w"]
    matrix: Float[np.ndarray, "4 4"]
    depth_scale: float


class SessionFolder(ResultFolder):
    """A session's folder, open for one configuration.

    **Raises:** `ValueError` if the folder holds a session of another configuration, or files that are not a session's.
    """

    kind, record_name, results = "session", "session.json", "image_*.npz"
    problem, remedy = "is not a session's record", "give the folder of a session"

    def count_images(self) -> int:
        """How many there are.

        **Raises:** `ValueError` if one before the last is missing.
        """
        # By their names: a link to a file that is gone is an image that cannot be read.
        names = {name for name in os.listdir(self.path) if re.fullmatch(r"image_\d{2,}\.npz", name)}
        for index in range(len(names)):
            file = _IMAGE.path(self.path, index)
            require(
                file.name in names,
                f"{self.path} holds {len(names)} images, but not {file.name}: restore it, or move those after it to "
                "another folder",
            )
        return len(names)

    def read_image(self, index: int) -> DepthImage:
        """**Raises:** `ValueError` if it is damaged."""
        return _IMAGE.read(self.path, index, _image)

    def write_image(self, index: int, image: DepthImage) -> None:
        """Write an image, all or nothing; the first of them binds the folder to its configuration."""
        self.bind()
        _IMAGE.write(self.path, index, image._asdict())

    def read_proposal(self, index: int) -> tuple[Proposal, Float[np.ndarray, "h w"] | None] | None:
        """The proposal for the image of an index, and the depth image that was expected of it (world units); None where
        it was not asked for.

        **Raises:** `ValueError` if it is damaged.
        """
        there = _PROPOSAL.path(self.path, index).exists()
        return _PROPOSAL.read(self.path, index, _proposal) if there else None

    def write_proposal(self, index: int, proposal: Proposal, expected: Float[np.ndarray, "h w"] | None) -> None:
        """Write a proposal, all or nothing."""
        seen = {} if expected is None else {"expected_depth": expected}
        _PROPOSAL.write(self.path, index, arrays_of(proposal.pose, POSE) | arrays_of(proposal, PROPOSAL) | seen)


def _image(data: dict[str, np.ndarray]) -> DepthImage:
    return DepthImage(data["depth"], data["matrix"], float(data["depth_scale"]))


def _proposal(data: dict[str, np.ndarray]) -> tuple[Proposal, Float[np.ndarray, "h w"] | None]:
    proposal = proposal_of(data)
    if proposal is None:
        raise ValueError("it has no values")
    return proposal, data.get("expected_depth")
