"""The examples for real sensors, with stand-ins for their drivers and messages."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_session import BOX, CAMERA, FIRST, POSES, planner_of, session_of, shot

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def transform_of(matrix):
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    translation = SimpleNamespace(**dict(zip("xyz", matrix[:3, 3].tolist(), strict=True)))
    return SimpleNamespace(rotation=SimpleNamespace(x=x, y=y, z=z, w=w), translation=translation)


def image_message(image, encoding, stamp, padding=0, big=False):
    """As sensor_msgs/Image has it, with rows that may be padded."""
    rows = np.pad(image, ((0, 0), (0, padding))).astype(image.dtype.newbyteorder(">" if big else "<"))
    height, width = image.shape
    step = rows.shape[1] * rows.itemsize
    header = SimpleNamespace(stamp=stamp)
    return SimpleNamespace(
        header=header, encoding=encoding, height=height, width=width, step=step, is_bigendian=big, data=rows.tobytes()
    )


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("encoding", "unit"), [("16UC1", 1000.0), ("32FC1", 1.0)])
def test_ros_images_are_read_to_the_pixel(encoding, unit, big):
    ros = load("ros2_next_view")
    image = shot(FIRST, unit).astype(np.uint16 if unit > 1 else np.float32)
    found, scale = ros.image_of(image_message(image, encoding, 0, padding=3, big=big))
    np.testing.assert_array_equal(found, image)
    assert scale == pytest.approx(1.0 / unit)


def test_ros_transforms_are_scipys():
    ros = load("ros2_next_view")
    for matrix in (FIRST, *POSES[:3]):
        np.testing.assert_allclose(ros.matrix_of(transform_of(matrix)), matrix, atol=1e-6)


@pytest.mark.slow
def test_the_ros_bridge_takes_images_and_publishes_where_to_go():
    """As a session by hand does; nothing before the camera is known."""
    ros = load("ros2_next_view")
    published, poses = [], {}
    bridge = ros.Bridge(
        lambda camera: session_of(camera=camera), lambda stamp: transform_of(poses[stamp]), published.append
    )
    assert bridge.take() == "there is no image yet"
    info = SimpleNamespace(k=CAMERA.intrinsics.reshape(-1).tolist(), width=64, height=48)
    session = session_of()
    matrix = FIRST
    for stamp in range(3):
        poses[stamp] = matrix
        bridge.on_camera_info(info)
        bridge.on_image(image_message(shot(matrix), "16UC1", stamp))
        assert bridge.take() == f"{stamp + 1} images"
        session.add(shot(matrix), matrix, depth_scale=1e-3)
        np.testing.assert_allclose(published[-1], session.next().matrix, atol=1e-5)
        matrix = published[-1]


class FakePipeline:
    """Gives the image of where the camera was held last."""

    held = FIRST

    def start(self):
        fx, fy, ppx, ppy = 90.0, 95.0, 34.0, 21.5
        intrinsics = SimpleNamespace(fx=fx, fy=fy, ppx=ppx, ppy=ppy, width=64, height=48)
        stream = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics))
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.001)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor)
        return SimpleNamespace(get_stream=lambda kind: stream, get_device=lambda: device)

    def wait_for_frames(self):
        frame = SimpleNamespace(get_data=lambda: shot(type(self).held))
        return SimpleNamespace(get_depth_frame=lambda: frame)

    def stop(self):
        type(self).held = None


def test_the_realsense_loop_runs(monkeypatch, tmp_path, capsys):
    driver = ModuleType("pyrealsense2")
    driver.stream, driver.pipeline = SimpleNamespace(depth="depth"), FakePipeline
    monkeypatch.setitem(sys.modules, "pyrealsense2", driver)
    example = load("realsense")

    def go_to(matrix):
        FakePipeline.held = matrix
        return matrix

    class Small(example.nbv.Session):
        def __init__(self, camera, box, planner, **given):
            assert camera.intrinsics == pytest.approx(CAMERA.intrinsics)
            super().__init__(CAMERA, BOX, planner_of(), up="z", poses=POSES, folder=given["folder"])

    def write_report(episode, path):
        assert len(episode.views) == 3
        return f"reported in {path}"

    monkeypatch.setattr(example, "go_to", go_to)
    monkeypatch.setattr(example.nbv, "write_report", write_report)
    monkeypatch.setattr(example.nbv, "Session", Small)
    monkeypatch.setattr(example.nbv, "look_at", lambda *a, **k: SimpleNamespace(matrix=FIRST))
    folder = str(tmp_path / "live")
    example.main(folder, views=3)
    assert f"3 images are taken reported in {folder}" in capsys.readouterr().out
    assert len(list((tmp_path / "live").glob("image_*.npz"))) == 3
    assert FakePipeline.held is None
