"""The examples for real sensors, with stand-ins for their drivers and messages."""

import importlib.util
import sys
import time
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


def info_message(matrix, width, height, d=(), model="plumb_bob", binning=(0, 0), roi=(0, 0, 0, 0)):
    """As sensor_msgs/CameraInfo has it; zeros stand for no binning and the whole image."""
    region = SimpleNamespace(**dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True)))
    return SimpleNamespace(
        k=np.reshape(matrix, -1).tolist(),
        d=list(d),
        distortion_model=model,
        width=width,
        height=height,
        roi=region,
        binning_x=binning[0],
        binning_y=binning[1],
    )


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("encoding", "unit"), [("16UC1", 1000.0), ("mono16", 1000.0), ("32FC1", 1.0)])
def test_ros_images_are_read_to_the_pixel(encoding, unit, big):
    ros = load("ros2_next_view")
    image = shot(FIRST, unit).astype(np.uint16 if unit > 1 else np.float32)
    found, scale = ros.image_of(image_message(image, encoding, 0, padding=3, big=big))
    np.testing.assert_array_equal(found, image)
    assert scale == pytest.approx(1.0 / unit)


@pytest.mark.parametrize("binning", [(0, 0), (1, 1), (2, 2), (4, 2)])
@pytest.mark.parametrize("roi", [(0, 0, 0, 0), (200, 100, 160, 120), (0, 0, 640, 480)])
def test_a_ros_camera_has_the_rays_of_its_region_and_binning(roi, binning):
    """A binned pixel looks along the mean of the rays of those that it stands for."""
    full = np.array([[600.0, 0.0, 318.6], [0.0, 605.0, 242.3], [0.0, 0.0, 1.0]])
    lens = (-0.1, 0.02, 0.0, 0.0, 0.0)
    camera = load("ros2_next_view").camera_of(info_message(full, 640, 480, lens, binning=binning, roi=roi))
    left, top, width, height = roi if roi[2] else (0, 0, 640, 480)
    across, down = (max(one, 1) for one in binning)
    assert (camera.width, camera.height, camera.distortion) == (width // across, height // down, lens)
    u, v = np.meshgrid(np.arange(left, left + width), np.arange(top, top + height))
    rays = np.stack([(u - 318.6) / 600.0, (v - 242.3) / 605.0], axis=-1)
    mean = rays.reshape(height // down, down, width // across, across, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(np.asarray(camera.pixel_directions())[:, :2], mean.reshape(-1, 2), atol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda ros: ros.image_of(image_message(np.zeros((2, 2), np.uint8), "8UC1", 0)), "'8UC1': publish depth as"),
        (lambda ros: ros.camera_of(info_message(CAMERA.intrinsics, 64, 48, (0.1,) * 4, "equidistant")), "rectify"),
        (lambda ros: ros.camera_of(info_message(np.zeros(9), 64, 48)), "positive focal lengths"),
    ],
)
def test_ros_streams_that_cannot_be_read_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(load("ros2_next_view"))


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
    info = info_message(CAMERA.intrinsics, 64, 48)
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
        assert bridge.take() == "there is no image yet"


class FakePipeline:
    """Gives the image of where the camera was held last, after those that it still holds of where it was before; they
    are stamped by a clock that is the computer's, or the device's own."""

    held, before, stale, domain = FIRST, FIRST, 0, "timestamp_domain.global_time"

    @classmethod
    def move(cls, matrix, stale):
        cls.held, cls.before, cls.stale, cls.moved = matrix, cls.held, stale, time.time()
        return matrix

    def start(self):
        fx, fy, ppx, ppy = 90.0, 95.0, 34.0, 21.5
        intrinsics = SimpleNamespace(fx=fx, fy=fy, ppx=ppx, ppy=ppy, width=64, height=48)
        stream = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics))
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.001)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor)
        return SimpleNamespace(get_stream=lambda kind: stream, get_device=lambda: device)

    def wait_for_frames(self):
        cls = type(self)
        is_stale, cls.stale = cls.stale > 0, cls.stale - 1
        image = shot(cls.before if is_stale else cls.held)
        moment = 1e3 * (cls.moved - 0.05 if is_stale else time.time())
        frame = SimpleNamespace(
            get_data=lambda: image,
            get_timestamp=lambda: 7.0 if "hardware" in cls.domain else moment,
            get_frame_timestamp_domain=lambda: cls.domain,
        )
        return SimpleNamespace(get_depth_frame=lambda: frame)

    def stop(self):
        type(self).held = None


@pytest.mark.parametrize(("clock", "stale"), [("global_time", 25), ("system_time", 3), ("hardware_clock", 9)])
def test_the_realsense_loop_pairs_images_with_their_poses(clock, stale, monkeypatch, tmp_path, capsys):
    driver = ModuleType("pyrealsense2")
    driver.stream, driver.pipeline = SimpleNamespace(depth="depth"), FakePipeline
    monkeypatch.setitem(sys.modules, "pyrealsense2", driver)
    example = load("realsense")
    monkeypatch.setattr(FakePipeline, "domain", f"timestamp_domain.{clock}")
    monkeypatch.setattr(FakePipeline, "held", FIRST)

    def go_to(matrix):
        return FakePipeline.move(matrix, stale)

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
    files = sorted((tmp_path / "live").glob("image_*.npz"))
    assert len(files) == 3
    for file in files:
        with np.load(file) as stored:
            np.testing.assert_array_equal(stored["depth"], shot(stored["matrix"]))
    assert FakePipeline.held is None
