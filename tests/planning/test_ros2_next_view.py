"""The ROS 2 example with messages that rosbags writes and reads with the types of ROS 2 Humble."""

import numpy as np
import pytest
import ros2_next_view as ros
from opencv_lens import undistort
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from small_session import CAMERA, FIRST, POSES, around, session_of, shot

import jaxnbv as nbv

TYPES = get_typestore(Stores.ROS2_HUMBLE)
FULL = np.array([[300.0, 0.0, 158.6], [0.0, 305.0, 122.3], [0.0, 0.0, 1.0]])
FULL_WIDTH, FULL_HEIGHT = 320, 240
# Moves pixels in the corners by 20 pixels.
LENS = (-0.25, 0.08, 0.002, -0.003, 0.01)
# Left, top, width, height.
WHOLE, REGION = (0, 0, 0, 0), (40, 20, 240, 200)
BALL, RADIUS = np.array([0.3, 0.2, 0.101]), 0.1


def message_of(name, *fields):
    package, kind = name.split("/")
    return TYPES.types[f"{package}/msg/{kind}"](*fields)


ORIGIN = message_of("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
NO_TURN = message_of("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 0.0)


def header_of(nanoseconds=0, frame="camera"):
    time = message_of("builtin_interfaces/Time", *divmod(nanoseconds, 1_000_000_000))
    return message_of("std_msgs/Header", time, frame)


def image_message(image, encoding, nanoseconds=0, padding=0, is_big=False):
    """An image whose rows are padded by some pixels."""
    rows = np.pad(image, ((0, 0), (0, padding))).astype(image.dtype.newbyteorder(">" if is_big else "<"))
    (height, width), data = image.shape, np.frombuffer(rows.tobytes(), np.uint8)
    step = rows.shape[1] * rows.itemsize
    return message_of("sensor_msgs/Image", header_of(nanoseconds), height, width, encoding, int(is_big), step, data)


def info_message(matrix, width, height, d=(), model="plumb_bob", binning=(0, 0), roi=WHOLE, projection=None):
    """A CameraInfo. Zeros stand for no binning and the whole image."""
    left, top, roi_width, roi_height = roi
    region = message_of("sensor_msgs/RegionOfInterest", left, top, roi_height, roi_width, False)
    projection = np.zeros((3, 4)) if projection is None else projection
    arrays = (np.array(values, float).reshape(-1) for values in (d, matrix, np.eye(3), projection))
    return message_of("sensor_msgs/CameraInfo", header_of(), height, width, model, *arrays, *binning, region)


def transform_message(matrix, nanoseconds=0):
    rotation = message_of("geometry_msgs/Quaternion", *Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist())
    translation = message_of("geometry_msgs/Vector3", *matrix[:3, 3].tolist())
    transform = message_of("geometry_msgs/Transform", translation, rotation)
    stamped = message_of("geometry_msgs/TransformStamped", header_of(nanoseconds, "world"), "camera", transform)
    return message_of("tf2_msgs/TFMessage", [stamped])


def through_ros(message):
    """The message as a subscriber gets it."""
    return TYPES.deserialize_cdr(TYPES.serialize_cdr(message, message.__msgtype__), message.__msgtype__)


def rotate(quaternion, vectors):
    """Vectors turned by a quaternion (x, y, z, w) of any length: q v q^-1."""
    axis, w = np.array(quaternion[:3]), quaternion[3]
    products = (w * w - axis @ axis) * vectors + 2 * (vectors @ axis)[:, None] * axis + 2 * w * np.cross(axis, vectors)
    return products / (w * w + axis @ axis)


@pytest.mark.parametrize("is_big", [False, True])
@pytest.mark.parametrize(("encoding", "unit"), [("16UC1", 1000.0), ("mono16", 1000.0), ("32FC1", 1.0)])
def test_ros_images_are_read_to_the_pixel(encoding, unit, is_big):
    image = shot(FIRST, unit).astype(np.uint16 if unit > 1 else np.float32)
    if unit == 1.0:
        # Values of REP 118: not measured, too far, too near.
        image[3, :3] = np.nan, np.inf, -np.inf
    message = through_ros(image_message(image, encoding, padding=3, is_big=is_big))
    depth, scale = ros.image_of(message)
    np.testing.assert_array_equal(depth, image)
    assert scale == pytest.approx(1.0 / unit)


@pytest.mark.parametrize("is_rectified", [False, True])
@pytest.mark.parametrize("binning", [(0, 0), (1, 1), (4, 2)])
@pytest.mark.parametrize("roi", [WHOLE, (200, 100, 160, 120), (0, 0, 640, 480)])
def test_a_ros_camera_has_the_rays_of_its_region_and_binning(roi, binning, is_rectified):
    """A binned pixel looks along the mean of the rays of those that it stands for. A rectified stream has the rays
    of P, although its CameraInfo still has the coefficients of the lens."""
    matrix = np.array([[600.0, 0.0, 318.6], [0.0, 605.0, 242.3], [0.0, 0.0, 1.0]])
    projection = np.array([[580.0, 0.0, 322.1, -30.0], [0.0, 590.0, 239.7, 0.0], [0.0, 0.0, 1.0, 0.0]])
    lens = (-0.1, 0.02, 0.001, 0.0, 0.0)
    info = info_message(matrix, 640, 480, lens, binning=binning, roi=roi, projection=projection)
    camera = ros.camera_of(through_ros(info), is_rectified)
    left, top, width, height = roi if roi[2] else (0, 0, 640, 480)
    across, down = (max(factor, 1) for factor in binning)
    assert (camera.width, camera.height) == (width // across, height // down)
    assert camera.distortion == (() if is_rectified else lens)
    fx, fy, cx, cy = (580.0, 590.0, 322.1, 239.7) if is_rectified else (600.0, 605.0, 318.6, 242.3)
    u, v = np.meshgrid(np.arange(left, left + width), np.arange(top, top + height))
    rays = np.stack([(u - cx) / fx, (v - cy) / fy], axis=-1)
    mean = rays.reshape(height // down, down, width // across, across, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(np.asarray(camera.pixel_directions())[:, :2], mean.reshape(-1, 2), atol=1e-5)


@pytest.mark.parametrize(
    ("reader", "message", "problem"),
    [
        ("image_of", image_message(np.zeros((2, 2), np.uint8), "8UC1"), "'8UC1': publish depth as"),
        ("camera_of", info_message(CAMERA.intrinsics, 64, 48, (0.1,) * 4, "equidistant"), "rectify"),
        ("camera_of", info_message(CAMERA.intrinsics, 64, 48, (0.0,) * 4, "equidistant"), "rectify"),
        ("camera_of", info_message(np.zeros(9), 64, 48), "positive focal lengths"),
        ("matrix_of", message_of("geometry_msgs/Transform", ORIGIN, NO_TURN), "zero norm"),
    ],
)
def test_ros_streams_that_cannot_be_read_are_named(reader, message, problem):
    with pytest.raises(ValueError, match=problem):
        getattr(ros, reader)(through_ros(message))


@pytest.mark.parametrize("length", [1.0, 0.995, -2.0])
def test_ros_poses_turn_as_their_quaternions(length):
    """tf2 lets quaternions pass that are a half per cent off the unit length."""
    vectors = np.random.default_rng(0).normal(size=(20, 3))
    message = transform_message(FIRST)
    transform = message.transforms[0].transform
    quaternion = length * Rotation.from_matrix(FIRST[:3, :3]).as_quat()
    for name, value in zip("xyzw", quaternion, strict=True):
        setattr(transform.rotation, name, float(value))
    matrix = ros.matrix_of(through_ros(message).transforms[0].transform)
    np.testing.assert_allclose(vectors @ matrix[:3, :3].T, rotate(quaternion, vectors), atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], FIRST[:3, 3], atol=1e-12)


def test_a_pose_is_published_as_it_is():
    vectors = np.random.default_rng(0).normal(size=(20, 3))
    point = message_of("geometry_msgs/Point", 0.0, 0.0, 0.0)
    pose = message_of("geometry_msgs/Pose", point, message_of("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0))
    ros.write_pose(pose, FIRST)
    message = through_ros(message_of("geometry_msgs/PoseStamped", header_of(frame="world"), pose))
    quaternion = [getattr(message.pose.orientation, name) for name in "xyzw"]
    np.testing.assert_allclose(rotate(quaternion, vectors), vectors @ FIRST[:3, :3].T, atol=1e-7)
    np.testing.assert_allclose([getattr(message.pose.position, name) for name in "xyz"], FIRST[:3, 3])


def depth_through_lens(matrix, roi, binning):
    """The depth of the ball on its table (z = 0) at the pixels of a region, binned, of the full image; in metres."""
    left, top, width, height = roi if roi[2] else (0, 0, FULL_WIDTH, FULL_HEIGHT)
    across, down = (max(factor, 1) for factor in binning)
    u, v = np.meshgrid(
        left + across * (np.arange(width // across) + 0.5) - 0.5, top + down * (np.arange(height // down) + 0.5) - 0.5
    )
    places = np.stack([(u - FULL[0, 2]) / FULL[0, 0], (v - FULL[1, 2]) / FULL[1, 1]], axis=-1)
    ideal = undistort(places, LENS)
    directions = np.concatenate([ideal, np.ones((*u.shape, 1))], axis=-1) @ matrix[:3, :3].T
    from_ball = matrix[:3, 3] - BALL
    a, b, c = (directions**2).sum(axis=-1), directions @ from_ball, from_ball @ from_ball - RADIUS**2
    root = b * b - a * c
    to_ball = np.where(root >= 0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
    to_table = np.where(directions[..., 2] < 0, -matrix[2, 3] / np.minimum(directions[..., 2], -1e-9), np.inf)
    return np.minimum(to_ball, to_table)


@pytest.mark.parametrize(
    ("roi", "binning", "encoding"), [(WHOLE, (0, 0), "16UC1"), (REGION, (2, 2), "32FC1")], ids=["whole", "region"]
)
def test_a_cloud_through_a_lens_lies_on_the_object(roi, binning, encoding):
    """The centre of the ball is beside the middle of the image, where the lens moves it."""
    matrix = around(0.7, 0.6, 0.5)
    matrix[:3, :3] @= Rotation.from_euler("y", 8.0, degrees=True).as_matrix()
    depth = depth_through_lens(matrix, roi, binning)
    image = depth.astype(np.float32) if encoding == "32FC1" else np.round(1000.0 * depth).astype(np.uint16)
    info = through_ros(info_message(FULL, FULL_WIDTH, FULL_HEIGHT, LENS, binning=binning, roi=roi))
    pose = nbv.Pose.from_matrix(ros.matrix_of(through_ros(transform_message(matrix)).transforms[0].transform))
    pixels, scale = ros.image_of(through_ros(image_message(image, encoding)))

    def distances():
        """Distance from the points of the cloud to the surface of the ball or the table."""
        box = nbv.Box((0.1, 0.0, -0.05), (0.5, 0.4, 0.3))
        points, _ = nbv.PointCloud.from_depth(pixels, ros.camera_of(info), pose, scale, box=box).to_numpy()
        return np.minimum(np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS), np.abs(points[:, 2]))

    with_lens = distances()
    info.d = np.zeros(5)
    assert len(with_lens) > 5000
    assert np.quantile(with_lens, 0.99) < 0.0015
    assert with_lens.max() < 0.003
    assert np.quantile(distances(), 0.99) > 0.005


class ThreeImages(nbv.StopRule):
    """Ends a session after its third image."""

    def after(self, context):
        return "three images" if len(context.poses) == 3 else None


def test_the_ros_bridge_takes_each_image_once_when_tf_reaches_it(tmp_path):
    """The second image comes before the transforms of its time."""
    matrices, encodings = [FIRST, POSES[2], POSES[9]], ["16UC1", "32FC1", "mono16"]
    images = [shot(matrix, 1.0 if index == 1 else 1000.0) for index, matrix in enumerate(matrices)]
    images[1] = np.where(images[1] > 0, images[1], np.nan).astype(np.float32)
    replies, goals, reached = [], [], [0]

    def lookup(stamp):
        message = through_ros(transform_message(matrices[stamp.sec]))
        return message.transforms[0].transform if stamp.sec <= reached[0] else None

    bridge = ros.Bridge(
        lambda camera: session_of(tmp_path / "live", camera=camera, until=ThreeImages()), lookup, goals.append
    )
    assert bridge.take() == "there is no image yet"
    bridge.on_camera_info(through_ros(info_message(CAMERA.intrinsics, CAMERA.width, CAMERA.height)))
    for index, (image, encoding) in enumerate(zip(images, encodings, strict=True)):
        message = image_message(image, encoding, index * 1_000_000_000, 5, is_big=encoding == "mono16")
        bridge.on_image(through_ros(message))
        if index == 1:
            replies.append(bridge.take())
        reached[0] = index
        replies.append(bridge.take())
        assert bridge.take() == "there is no image yet"
    again = "tf does not reach the image's time yet: call again"
    assert replies == ["1 images", again, "2 images", "done: three images"]

    np.testing.assert_allclose(bridge.session.camera.intrinsics, CAMERA.intrinsics, atol=1e-9)
    for index, file in enumerate(sorted((tmp_path / "live").glob("image_*.npz"))):
        with np.load(file) as arrays:
            np.testing.assert_allclose(arrays["matrix"], matrices[index], atol=1e-6)
            np.testing.assert_array_equal(arrays["depth"], images[index])
            assert arrays["depth_scale"] == pytest.approx(1.0 if index == 1 else 0.001)
    nearest = [np.abs(POSES - matrix).max(axis=(1, 2)) for matrix in goals]
    assert np.max(np.min(nearest, axis=1)) < 1e-5
    assert len(set(np.argmin(nearest, axis=1))) == len(goals) == 2
    points, _ = bridge.session.cloud.to_numpy()
    distances = np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS)
    assert len(points) > 200
    assert np.median(distances) < 0.0005
    assert distances.max() < 0.002
