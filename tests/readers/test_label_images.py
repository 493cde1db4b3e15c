"""Masks and label images beside a recording's frames."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxnbv.checks import InputError
from jaxnbv.readers.segmentation import Segmentation

FRAMES = (Path("depth/0001.png"), Path("depth/0002.png"), Path("depth/0011.png"))


def write(file, pixels):
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file)


def test_a_mask_for_each_object_becomes_one_image_of_numbers(tmp_path):
    """Numbers follow the alphabetical order of names, in all frames alike. Any value but zero is part of a mask."""
    write(tmp_path / "0001.mug.png", [[0, 255, 1]])
    write(tmp_path / "0001_bowl.png", [[7, 0, 0]])
    write(tmp_path / "0011.mug.png", [[255, 0, 0]])
    masks = Segmentation(tmp_path, FRAMES)
    assert masks.names == {1: "bowl", 2: "mug"}
    assert masks.labels(0).tolist() == [[1, 2, 2]]
    assert masks.labels(1) is None
    assert masks.labels(2).tolist() == [[2, 0, 0]]


def test_a_frame_of_7_scenes_has_its_numbers_beside_it(tmp_path):
    write(tmp_path / "frame-000003.png", [[0, 4], [9, 0]])
    masks = Segmentation(tmp_path, (Path("frame-000003.depth.png"),))
    assert masks.names == {}
    assert masks.labels(0).tolist() == [[0, 4], [9, 0]]


def test_what_is_no_segmentation_is_refused(tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        Segmentation(tmp_path / "none", FRAMES)
    with pytest.raises(InputError, match=r"such as 0001\.png: name them 0001\.png, .* or 0001\.OBJECT\.png"):
        Segmentation(tmp_path, FRAMES)
    with pytest.raises(InputError, match="there are no frames: give the files"):
        Segmentation(tmp_path, ())
    write(tmp_path / "0001.png", np.zeros((2, 2, 3)))
    with pytest.raises(InputError, match=r"shape \(2, 2, 3\): give an image of one channel"):
        Segmentation(tmp_path, FRAMES).labels(0)
    (tmp_path / "0002.png").write_text("no image")
    with pytest.raises(InputError, match=r"cannot read .*0002\.png"):
        Segmentation(tmp_path, FRAMES).labels(1)
