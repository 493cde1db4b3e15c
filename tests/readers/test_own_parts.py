"""Parts that move with the camera, against things that look the same from every pose."""

import json

import numpy as np
import pytest
from PIL import Image

import jaxnbv as nbv
from jaxnbv.readers.own_parts import own_parts

HEIGHT, WIDTH, SCALE = 90, 120, 1e-3
CAMERA = nbv.Camera(1.6, HEIGHT, WIDTH)
BALL, RADIUS = np.array([0.0, 0.0, 0.1]), 0.1
# Rows and columns of a gripper, and its depth in metres.
GRIPPER, NEAR = (slice(66, 90), slice(80, 120)), 0.08


def orbit(count=12, away=0.5):
    """Poses around the z axis at one height."""
    turns = 2.0 * np.pi * np.arange(count) / count
    places = away * np.stack([np.cos(turns), np.sin(turns), np.full(count, 0.8)], axis=-1)
    return np.asarray(nbv.look_at(places.astype(np.float32), up=(0.0, 0.0, 1.0)).to_matrix(), float)


def seen(matrix):
    """Depths in metres of a ball on a table at z = 0, in closed form."""
    rays = np.asarray(CAMERA.pixel_directions(), float) @ matrix[:3, :3].T
    place = matrix[:3, 3]
    with np.errstate(divide="ignore"):
        table = np.where(rays[:, 2] < 0, -place[2] / rays[:, 2], np.inf)
    half, square = rays @ (place - BALL), np.sum(rays**2, axis=1)
    root = half**2 - square * (np.sum((place - BALL) ** 2) - RADIUS**2)
    ball = np.where(root > 0, (-half - np.sqrt(np.maximum(root, 0.0))) / square, np.inf)
    depth = np.minimum(table, ball).reshape(HEIGHT, WIDTH)
    return np.where(depth < 60.0, depth, 0.0)


def images(matrices, with_gripper):
    """Images in units, with errors of 0.3 % and a fifth of the pixels lost."""
    rng, depths = np.random.default_rng(0), []
    for matrix in matrices:
        depth = seen(matrix)
        if with_gripper:
            depth[GRIPPER] = NEAR
        depth = depth * (1.0 + 0.003 * rng.standard_normal(depth.shape)) * (rng.random(depth.shape) > 0.2)
        depths.append(np.round(depth / SCALE).astype(np.uint16))
    return depths


@pytest.mark.parametrize("with_gripper", [True, False])
def test_a_gripper_is_found_and_a_ball_on_the_axis_is_kept(with_gripper):
    """From a level orbit, ball and table look the same in all frames, like the gripper. The frames must lose only its
    pixels."""
    matrices = orbit()
    frames = images(matrices, with_gripper)
    assert np.ptp([seen(matrix)[45, 60] for matrix in matrices]) < 1e-3
    reach = own_parts(frames.__getitem__, matrices, CAMERA, SCALE)
    is_gripper = np.zeros((HEIGHT, WIDTH), bool)
    is_gripper[GRIPPER] = with_gripper
    for frame in frames:
        np.testing.assert_array_equal((frame > 0) & (frame <= reach), (frame > 0) & is_gripper)


def test_nothing_is_found_in_few_frames_or_where_the_camera_stands_still():
    for matrices in (orbit()[:3], np.repeat(orbit()[:1], 8, axis=0)):
        assert not own_parts(images(matrices, True).__getitem__, matrices, CAMERA, SCALE).any()


def test_an_image_of_another_size_is_passed_over():
    matrices = orbit()
    frames = images(matrices, True)
    frames[3] = frames[3][:50]
    assert (own_parts(frames.__getitem__, matrices, CAMERA, SCALE)[GRIPPER] > 0).all()


def test_a_recording_loses_its_gripper_and_says_so(tmp_path):
    matrices = orbit()
    frames = images(matrices, True)
    for index, frame in enumerate(frames):
        Image.fromarray(frame).save(tmp_path / f"{index}.png")
    written = [{"depth": f"{index}.png", "pose": matrix.tolist()} for index, matrix in enumerate(matrices)]
    content = {"intrinsics": np.asarray(CAMERA.intrinsics).tolist(), "depth_scale": SCALE, "frames": written}
    (tmp_path / "frames.json").write_text(json.dumps(content))
    recording = nbv.readers.RecordedFrames(tmp_path)
    with pytest.warns(UserWarning, match="parts of the camera's mount"):
        first = recording.depth(0)
    expected = frames[0].copy()
    expected[GRIPPER] = 0
    np.testing.assert_array_equal(first, expected)
