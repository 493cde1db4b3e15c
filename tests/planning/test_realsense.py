"""The example for RealSense cameras, with librealsense's software device. Its pipeline, profiles and frames are those
of a camera, and the test supplies the pixels."""

import ctypes
import importlib
import itertools
import sys
import time

import numpy as np
import pytest
from opencv_lens import distort
from small_session import planner_of

import jaxnbv as nbv
from jaxnbv.scanning import SDFSurface, scan
from jaxnbv.scanning.sdf import Cuboid, Sphere

if sys.platform == "linux":
    # The wheel of pyrealsense2 has no libusb, and not every machine has one.
    libusb_package = pytest.importorskip("libusb_package", reason="pyrealsense2 needs libusb")
    ctypes.CDLL(str(libusb_package.get_library_path()))
rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this platform")
example = importlib.import_module("realsense")

# In metres, within the example's box: a ball and a block on a table whose top is at z = 0.
OBJECT = Sphere(0.07).translate([-0.03, 0.02, 0.075]) | Cuboid([0.03, 0.05, 0.055]).translate([0.07, -0.04, 0.06])
WORLD = SDFSurface(OBJECT | Cuboid([1.0, 1.0, 0.02]).translate([0.0, 0.0, -0.02]))
WIDTH, HEIGHT = 64, 48
FX, FY, PPX, PPY = 90.0, 95.0, 34.0, 21.5
CAMERA = nbv.Camera.from_intrinsics([[FX, 0.0, PPX], [0.0, FY, PPY], [0.0, 0.0, 1.0]], HEIGHT, WIDTH)
CLOCKS = rs.timestamp_domain
POSES = [
    np.asarray(nbv.look_at((0.5 * x, 0.5 * y, 0.4), (0.0, 0.0, 0.1), up=(0.0, 0.0, 1.0)).matrix)
    for x, y in ((0.0, -1.0), (0.8, 0.6), (-0.6, 0.8))
]


def depth_image(matrix, unit):
    """The image of a depth camera from a pose: whole multiples of a unit in metres, 0 without a measurement."""
    pose = nbv.Pose.from_matrix(matrix)
    view = scan(WORLD, CAMERA, pose)
    depth = (np.asarray(view.points, np.float64) - np.asarray(pose.position)) @ np.asarray(pose.forward, np.float64)
    return np.round(np.where(view.mask, depth / unit, 0.0)).reshape(HEIGHT, WIDTH).astype(np.uint16)


class SoftwareCamera:
    """A librealsense device with a depth sensor. After a move it still gives `num_stale` frames of the pose before.

    - `domain`: the clock of its time stamps.
    - `unit`: metres per unit of its images.
    - `delay`: by how many seconds its stamps are behind the computer's clock.
    - `coefficients`, `model`: the lens of its depth stream.
    """

    def __init__(self, domain, unit=0.001, num_stale=0, delay=0.0, coefficients=(), model=rs.distortion.brown_conrady):
        self.domain, self.unit, self.num_stale, self.delay = domain, unit, num_stale, delay
        self.image = self.previous_image = np.zeros((HEIGHT, WIDTH), np.uint16)
        self.move_time, self.num_stale_left, self.frame_numbers = time.time(), 0, itertools.count(1)
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "software camera")
        self.device.register_info(rs.camera_info.serial_number, "1")
        self.sensor = self.device.add_sensor("Stereo Module")
        self.sensor.add_read_only_option(rs.option.depth_units, unit)
        depth = self.add_stream(rs.stream.depth, rs.format.z16, 2, coefficients, model)
        self.profile = depth.as_video_stream_profile()
        # Real cameras have a second stream, which is on by default.
        self.add_stream(rs.stream.infrared, rs.format.y8, 1, (), model)

    def add_stream(self, kind, pixel_format, num_bytes, coefficients, model):
        intrinsics = rs.intrinsics()
        intrinsics.width, intrinsics.height, intrinsics.model = WIDTH, HEIGHT, model
        intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = FX, FY, PPX, PPY
        intrinsics.coeffs = [*coefficients, *[0.0] * (5 - len(coefficients))]
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.bpp, stream.uid = kind, pixel_format, num_bytes, int(kind)
        stream.width, stream.height, stream.fps, stream.intrinsics = WIDTH, HEIGHT, 30, intrinsics
        return self.sensor.add_video_stream(stream, True)

    def move(self, matrix):
        self.previous_image, self.image = self.image, depth_image(matrix, self.unit)
        self.num_stale_left, self.move_time = self.num_stale, time.time()

    def send_frame(self):
        """Hand the next frame to librealsense. The camera's own clock counts from its start."""
        is_stale, self.num_stale_left = self.num_stale_left > 0, self.num_stale_left - 1
        frame = rs.software_video_frame()
        frame.pixels, frame.bpp, frame.stride = self.previous_image if is_stale else self.image, 2, 2 * WIDTH
        frame.frame_number, frame.domain, frame.profile = next(self.frame_numbers), self.domain, self.profile
        seconds = self.move_time - 0.05 if is_stale else time.time()
        milliseconds = 1e3 * (seconds - self.delay)
        frame.timestamp = 33.3 * frame.frame_number if self.domain == CLOCKS.hardware_clock else milliseconds
        self.sensor.on_video_frame(frame)


class Pipeline(rs.pipeline):
    """librealsense's pipeline of a `SoftwareCamera`, which sends a frame whenever one is waited for."""

    def __init__(self, camera):
        super().__init__()
        self.set_device(camera.device)
        self.camera = camera

    def wait_for_frames(self):
        self.camera.send_frame()
        return super().wait_for_frames(2000)


@pytest.fixture
def start():
    """Starts the pipeline of a camera with its depth stream alone, as the example does."""
    pipelines = []

    def start_pipeline(camera):
        pipelines.append(Pipeline(camera))
        config = rs.config()
        config.enable_stream(rs.stream.depth)
        return pipelines[-1], pipelines[-1].start(config)

    yield start_pipeline
    for pipeline in pipelines:
        pipeline.stop()


@pytest.mark.slow
def test_the_realsense_loop_scans_the_object(monkeypatch, tmp_path, capsys):
    """Each image is of the pose that the camera reached, and the cloud lies on the object."""
    camera = SoftwareCamera(CLOCKS.global_time, 0.00025, num_stale=25)
    pipeline, poses, episodes = Pipeline(camera), [], []

    def go_to(matrix):
        """A robot that stops some millimetres beside the pose."""
        assert [stream.stream_type() for stream in pipeline.get_active_profile().get_streams()] == [rs.stream.depth]
        poses.append(matrix + 0.003 * np.eye(4, k=3))
        camera.move(poses[-1])
        return poses[-1]

    def write_report(episode, path):
        episodes.append(episode)
        return f"report in {path}"

    monkeypatch.setattr(example, "go_to", go_to)
    monkeypatch.setattr(example.nbv, "write_report", write_report)
    planner = planner_of(nbv.DiscreteSearch(nbv.SphereCandidates(8)))
    folder = tmp_path / "live"
    with pytest.warns(UserWarning, match="table"):
        example.main(str(folder), views=3, pipeline=pipeline, planner=planner)

    assert f"3 images are taken report in {folder}" in capsys.readouterr().out
    with pytest.raises(RuntimeError, match="before start"):
        pipeline.stop()
    files = sorted(folder.glob("image_*.npz"))
    assert len(files) == len(poses) == 3
    for file, matrix in zip(files, poses, strict=True):
        with np.load(file) as arrays:
            np.testing.assert_allclose(arrays["matrix"], matrix, atol=1e-6)
            np.testing.assert_array_equal(arrays["depth"], depth_image(matrix, 0.00025))
            assert arrays["depth_scale"] == pytest.approx(0.00025)
    points, _ = episodes[0].frame.to_world(episodes[0].cloud).to_numpy()
    distances = np.abs(np.asarray(OBJECT(points)))
    assert len(points) > 200
    assert np.median(distances) < 0.001
    assert np.quantile(distances, 0.99) < 0.003


@pytest.mark.parametrize(
    ("clock", "num_stale"),
    [(CLOCKS.global_time, 3), (CLOCKS.system_time, 60), (CLOCKS.hardware_clock, 9)],
)
def test_a_frame_is_of_the_pose_after_the_move(clock, num_stale, start):
    """Time stamps skip any number of stale frames. A camera with a clock of its own may hold few."""
    camera = SoftwareCamera(clock, num_stale=num_stale)
    pipeline, _ = start(camera)
    for matrix in POSES:
        camera.move(matrix)
        frame = example.depth_frame(pipeline, time.time())
        np.testing.assert_array_equal(np.asanyarray(frame.get_data()), depth_image(matrix, 0.001))


def test_a_clock_that_is_behind_is_an_error(start):
    pipeline, _ = start(SoftwareCamera(CLOCKS.global_time, delay=60.0))
    with pytest.raises(RuntimeError, match="global_time_enabled"):
        example.depth_frame(pipeline, time.time())


def test_rays_and_unit_are_librealsenses(start):
    software_camera = SoftwareCamera(CLOCKS.global_time, unit=0.0001)
    _, profile = start(software_camera)
    camera, scale = example.depth_camera(profile)
    assert scale == pytest.approx(0.0001)
    assert (camera.nearest, camera.farthest, camera.distortion) == (0.2, 2.0, ())
    intrinsics = software_camera.profile.get_intrinsics()
    pixels = [[column, row] for row in range(HEIGHT) for column in range(WIDTH)]
    rays = [rs.rs2_deproject_pixel_to_point(intrinsics, pixel, 1.0) for pixel in pixels]
    np.testing.assert_allclose(np.asarray(camera.pixel_directions()), rays, atol=1e-6)


def test_a_lens_is_opencvs_or_an_error(start):
    """librealsense projects through a Brown-Conrady lens by OpenCV's formula."""
    coefficients = (-0.1, 0.05, 0.002, -0.003, 0.01)
    software_camera = SoftwareCamera(CLOCKS.global_time, coefficients=coefficients)
    camera, _ = example.depth_camera(start(software_camera)[1])
    assert camera.distortion == pytest.approx(coefficients)
    place = np.array([0.21, -0.13])
    pixel = rs.rs2_project_point_to_pixel(software_camera.profile.get_intrinsics(), [*place, 1.0])
    np.testing.assert_allclose(pixel, distort(place, coefficients) * (FX, FY) + (PPX, PPY), atol=1e-4)

    inverse = SoftwareCamera(CLOCKS.global_time, coefficients=coefficients, model=rs.distortion.inverse_brown_conrady)
    with pytest.raises(ValueError, match="inverse_brown_conrady"):
        example.depth_camera(start(inverse)[1])
