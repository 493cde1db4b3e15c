"""The voxels of a box that the frames of a small recording show, and the box around them."""

import numpy as np
import pytest
from small_recording import INTRINSICS, UNIT, known_sensor, plain, points_of, recorded

from jaxnbv.geometry.volume import Box
from jaxnbv.readers import RecordedFrames
from jaxnbv.studies.shown_voxels import bounds_of, read_recording

LOW, HIGH, VOXEL = (0.6, 1.6, 0.3), (1.4, 2.4, 0.9), 0.01


@pytest.fixture(scope="module")
def sequence():
    return recorded()


def shown_in(folder):
    box = Box(LOW, HIGH)
    return read_recording((str(folder), None, None, None), box, VOXEL, box).is_shown


def voxels_of(depth, matrix):
    """Voxels in the box that a depth image shows, from its pixels in float64."""
    world = points_of(depth / UNIT, INTRINSICS, matrix)
    inside = np.all((world > LOW) & (world < HIGH), axis=1)
    return {tuple(place) for place in np.floor(world[inside] / VOXEL).astype(int)}


def test_voxels_count_if_three_frames_show_them(sequence, tmp_path):
    """From all pixels. By rounding, a few are in the next voxel."""
    voxels = [voxels_of(*frame) for frame in zip(*sequence, strict=True)]
    often = {place for place in set().union(*voxels) if sum(place in one for one in voxels) >= 3}
    known_sensor(plain, tmp_path, sequence)
    is_shown = shown_in(tmp_path)
    assert is_shown.shape[1] == pytest.approx(len(often), rel=0.01)
    expected = [len(one & often) / len(often) for one in voxels]
    np.testing.assert_allclose(is_shown.mean(axis=1), expected, atol=0.01)
    assert (is_shown.sum(axis=0) >= 3).all()


def test_a_frame_that_looks_away_shows_nothing(sequence, tmp_path):
    depths, matrices = sequence
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    looks = np.concatenate([depths, depths[:1]]), np.concatenate([matrices, matrices[:1] @ back])
    known_sensor(plain, tmp_path, looks)
    counts = shown_in(tmp_path).sum(axis=1)
    assert counts[-1] == 0
    assert (counts[:-1] > 0).all()


def test_the_default_box_has_room_around_what_was_seen(sequence, tmp_path):
    known_sensor(plain, tmp_path, sequence)
    corners = bounds_of(RecordedFrames(tmp_path))
    low, high = corners[:3], corners[3:]
    # The whole ball, except for the side that faces away from all cameras.
    np.testing.assert_allclose(high, [1.33, 2.33, 0.83], atol=0.03)
    np.testing.assert_allclose(low[:2], [0.67, 1.92], atol=0.15)
    assert (np.array(high) > [1.299, 2.299, 0.799]).all()
