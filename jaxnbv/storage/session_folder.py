"""A live session on disk, written image by image.

session.json      the configuration (planner, sensor, box, what is up) and the versions that made it
image_00.npz      the first depth image as the sensor gave it, its pose and scale; image_01.npz and so on
proposal_01.npz   where the planner wanted the image of that number to be taken; its candidates and their values
"""

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Real

from jaxnbv.checks import require
from jaxnbv.search import Proposal
from jaxnbv.storage.arrays import (
    POSE,
    PROPOSAL,
    Schema,
    pose_arrays,
    proposal_arrays,
    proposal_of,
    read_arrays,
    write_arrays,
)
from jaxnbv.storage.folders import ResultFolder, read_config

SESSION_RECORD = "session.json"
_IMAGE: Schema = {
    "depth": ("uif", ("h", "w")),
    "matrix": ("f", (4, 4)),
    "depth_scale": ("f", ()),
    "camera": ("i", ()),
}
_PROPOSAL: Schema = {**POSE, **PROPOSAL, "expected_depth": ("f", ("h", "w"))}


class DepthImage(NamedTuple):
    """What a sensor gave.

    - `depth`: along the forward axis; `depth_scale` times it is in world units.
    - `matrix`: camera to world, in the convention of the session.
    - `camera`: which of the session's cameras it is of.
    """

    depth: Real[np.ndarray, "h w"]
    matrix: Float[np.ndarray, "4 4"]
    depth_scale: float
    camera: int = 0


class SessionFolder(ResultFolder):
    """A session's folder, open for one configuration.

    **Raises:** `ValueError` if the folder holds a session of another configuration, or files that are not a session's.
    """

    def __init__(self, path: str | Path, config: dict[str, Any]):
        super().__init__(path, SESSION_RECORD, "image_*.npz", config, "session")

    def count_images(self) -> int:
        """How many there are.

        **Raises:** `ValueError` if one before the last is missing.
        """
        # By their names: a link to a file that is gone is an image that cannot be read.
        names = {name for name in os.listdir(self.path) if re.fullmatch(r"image_\d{2,}\.npz", name)}
        for index in range(len(names)):
            file = self._image_file(index)
            require(
                file.name in names,
                f"{self.path} holds {len(names)} images, but not {file.name}: restore it, or move those after it to "
                "another folder",
            )
        return len(names)

    def read_image(self, index: int) -> DepthImage:
        """**Raises:** `ValueError` if it is damaged."""
        remedy = "restore it, or delete it and those after it"
        return read_arrays(self._image_file(index), index, _IMAGE, _image, "image", remedy)

    def write_image(self, index: int, image: DepthImage) -> None:
        """Write an image, all or nothing; the first of them binds the folder to its configuration."""
        self.bind()
        write_arrays(self._image_file(index), index, image._asdict())

    def read_proposal(self, index: int) -> tuple[Proposal, Float[np.ndarray, "h w"] | None] | None:
        """The proposal for the image of an index, and the depth image that was expected of it (world units); None where
        it was not asked for.

        **Raises:** `ValueError` if it is damaged.
        """
        file = self._proposal_file(index)
        if not file.exists():
            return None
        return read_arrays(file, index, _PROPOSAL, _proposal, "proposal", "delete it, and it is asked for again")

    def write_proposal(self, index: int, proposal: Proposal, expected: Float[np.ndarray, "h w"] | None) -> None:
        """Write a proposal, all or nothing."""
        seen = {} if expected is None else {"expected_depth": expected}
        write_arrays(self._proposal_file(index), index, pose_arrays(proposal.pose) | proposal_arrays(proposal) | seen)

    def _image_file(self, index: int) -> Path:
        return self.path / f"image_{index:02d}.npz"

    def _proposal_file(self, index: int) -> Path:
        return self.path / f"proposal_{index:02d}.npz"


def open_session(path: str | Path) -> SessionFolder:
    """The folder of a session, whatever its configuration, which is its `config`.

    **Raises:** `ValueError` if it holds no session.
    """
    record = Path(path) / SESSION_RECORD
    return SessionFolder(path, read_config(record, "is not a session's record", "give the folder of a session"))


def _image(data: dict[str, np.ndarray]) -> DepthImage:
    return DepthImage(data["depth"], data["matrix"], float(data["depth_scale"]), int(data["camera"]))


def _proposal(data: dict[str, np.ndarray]) -> tuple[Proposal, Float[np.ndarray, "h w"] | None]:
    proposal = proposal_of(data)
    if proposal is None:
        raise ValueError("it has no values")
    return proposal, data.get("expected_depth")
