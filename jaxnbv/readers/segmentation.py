"""Reads the label images or masks of the objects in a recording."""

from pathlib import Path

import numpy as np
from jaxtyping import Int

from jaxnbv.checks import InputError, require
from jaxnbv.errors import optional

_ENDINGS = (".depth.png", ".png", ".tif", ".tiff", ".pgm")
_SEPARATORS = "._-"


class Segmentation:
    """A folder of label images or masks, which say which object each pixel of a recording shows.

    `frames` are the files of the recording's depth images. For each frame that shows an object, such as `000012.png`,
    the folder has one of these:

    - a label image with the frame's name, `000012.png`. Each pixel holds an object number, or zero for no object;
    - one mask per object, named after frame and object, such as `000012.cup.png` or `000012_cup.png`. It is nonzero
      where the object is seen.

    **Raises:** `ValueError` if there is no such folder, if there are no frames, or if no frame has an image.
    """

    def __init__(self, folder: str | Path, frames: tuple[Path, ...]):
        folder = Path(folder)
        require(len(frames) > 0, "there are no frames: give the files of a recording's depth images")
        require(folder.is_dir(), f"there is no folder {folder}: give the one that holds the masks")
        stems = [_stem(frame) for frame in frames]
        files = {_stem(file): file for file in sorted(folder.iterdir()) if file.name != _stem(file)}
        self._files = [_frame_files(stem, files) for stem in stems]
        objects = sorted({name for images in self._files for name in images if name})
        self._numbers = {name: number for number, name in enumerate(objects, start=1)}
        if not any(self._files):
            raise InputError(
                f"no image in {folder} belongs to a frame of the recording, such as {frames[0].name}: name them "
                f"{stems[0]}.png, with a number for each pixel, or {stems[0]}.OBJECT.png, a mask for each object"
            )

    @property
    def names(self) -> dict[int, str]:
        """Names of the objects with masks, keyed by object number. Objects of label images have no names."""
        return {number: name for name, number in self._numbers.items()}

    def labels(self, index: int) -> Int[np.ndarray, "height width"] | None:
        """Return the object number of each pixel of a frame; zero where the pixel shows no object.

        Returns None if the folder has neither a label image nor a mask for the frame.

        **Raises:** `ValueError` for an image that cannot be read, or has several channels.
        """
        labels = None
        for name, file in self._files[index].items():
            try:
                pixels = np.asarray(optional("PIL.Image").open(file)).astype(int)
            except OSError as error:
                raise InputError(f"cannot read {file} ({error}): write it again") from error
            require(pixels.ndim == 2, f"{file} has the shape {pixels.shape}: give an image of one channel")
            object_labels = np.where(pixels > 0, self._numbers[name], 0) if name else pixels
            labels = object_labels if labels is None else np.where(labels > 0, labels, object_labels)
        return labels


def _stem(file: Path) -> str:
    ending = next((ending for ending in _ENDINGS if file.name.lower().endswith(ending)), "")
    return file.name[: len(file.name) - len(ending)]


def _frame_files(stem: str, files: dict[str, Path]) -> dict[str, Path]:
    """Return the masks of a frame, keyed by object name, or its label image with the key "".

    - `stem`: name of the frame's file without ending.
    - `files`: all image files in the folder of masks, keyed by their names without endings.
    """
    if stem in files:
        return {"": files[stem]}
    return {
        other[len(stem) + 1 :]: file
        for other, file in files.items()
        if other.startswith(stem) and len(other) > len(stem) + 1 and other[len(stem)] in _SEPARATORS
    }
