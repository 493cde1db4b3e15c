"""A thin ROS 2 node about a session: depth images in, the next pose of the camera out.

Topics: `depth/image` (sensor_msgs/Image, 16UC1 or mono16 in millimetres, 32FC1 in metres), `depth/camera_info`
(sensor_msgs/CameraInfo, with its distortion, region of interest and binning) and `next_view`
(geometry_msgs/PoseStamped). The camera's pose is that of `camera_frame` in `world_frame`, by tf at the image's time.
Camera frames of ROS look along z with y down, which is OpenCV's convention. The service `take` (std_srvs/Trigger) adds
the latest image, since most images of a stream show nothing new.

The functions and `Bridge` need no ROS: `tests/planning/test_ros2_next_view.py` passes messages to them. The node in
`main` has not run.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import jaxnbv as nbv

_DTYPES = {"16UC1": (np.uint16, 1e-3), "mono16": (np.uint16, 1e-3), "32FC1": (np.float32, 1.0)}
# The models of sensor_msgs/CameraInfo that are OpenCV's; some drivers leave the name empty.
_MODELS = ("plumb_bob", "rational_polynomial", "")
# A fisheye lens, which bends rays even where all of its coefficients are zero.
_FISHEYE = "equidistant"


def image_of(message: Any) -> tuple[np.ndarray, float]:
    """The depth image of a message, and metres per unit.

    **Raises:** `ValueError` for another encoding.
    """
    if message.encoding not in _DTYPES:
        raise ValueError(f"the image's encoding is {message.encoding!r}: publish depth as one of {', '.join(_DTYPES)}")
    dtype, scale = _DTYPES[message.encoding]
    rows = np.frombuffer(bytes(message.data), np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<"))
    image = rows.reshape(message.height, message.step // np.dtype(dtype).itemsize)[:, : message.width]
    return image.astype(dtype), scale


def camera_of(message: Any, is_rectified: bool = False) -> nbv.Camera:
    """The camera of a stream. A message has the matrix and the size of the full image. The stream shows the region of
    interest, which is given in full pixels, and bins it.

    - `is_rectified`: whether the images come from image_proc. It leaves K and D of the message as they were. Then the
      intrinsics are those of P, and there is no distortion.

    **Raises:** `ValueError` for a lens model that is not OpenCV's, or a matrix of zeros, which means uncalibrated.
    """
    matrix = (
        np.array(message.p, float).reshape(3, 4)[:, :3] if is_rectified else np.array(message.k, float).reshape(3, 3)
    )
    coefficients = () if is_rectified or not np.any(message.d) else tuple(message.d)
    model = message.distortion_model
    if not is_rectified and (model == _FISHEYE or (coefficients and model not in _MODELS)):
        raise ValueError(
            f"the distortion is {model!r}: rectify the stream (image_proc) and set the parameter is_rectified"
        )
    roi, binning = message.roi, (max(message.binning_x, 1), max(message.binning_y, 1))
    width, height = (roi.width or message.width) // binning[0], (roi.height or message.height) // binning[1]
    for row, (offset, factor) in enumerate(zip((roi.x_offset, roi.y_offset), binning, strict=True)):
        matrix[row] /= factor
        # The centre of the first binned pixel is in the middle of the pixels that it combines.
        matrix[row, 2] -= (offset + 0.5 * (factor - 1)) / factor
    return nbv.Camera.from_intrinsics(matrix, height, width, distortion=coefficients)


def matrix_of(transform: Any) -> np.ndarray:
    """The 4 x 4 matrix of a geometry_msgs/Transform, whose quaternion may have any length.

    **Raises:** `ValueError` for a quaternion of zeros.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([getattr(transform.rotation, name) for name in "xyzw"]).as_matrix()
    matrix[:3, 3] = [getattr(transform.translation, name) for name in "xyz"]
    return matrix


def write_pose(pose: Any, matrix: np.ndarray) -> None:
    """Write a 4 x 4 matrix into a geometry_msgs/Pose."""
    for name, value in zip("xyz", matrix[:3, 3], strict=True):
        setattr(pose.position, name, float(value))
    for name, value in zip("xyzw", Rotation.from_matrix(matrix[:3, :3]).as_quat(), strict=True):
        setattr(pose.orientation, name, float(value))


class Bridge:
    """Messages in, the next pose out.

    - `start`: makes the session of a camera.
    - `lookup`: returns the geometry_msgs/Transform from camera to world at a time stamp, or None before tf reaches it.
    - `publish`: receives the next pose, a 4 x 4 matrix, camera to world.
    - `is_rectified`: see `camera_of`.
    """

    def __init__(
        self,
        start: Callable[[nbv.Camera], nbv.Session],
        lookup: Callable[[Any], Any | None],
        publish: Callable[[np.ndarray], None],
        is_rectified: bool = False,
    ):
        self.start, self.lookup, self.publish, self.is_rectified = start, lookup, publish, is_rectified
        self.session: nbv.Session | None = None
        self.latest: Any = None

    def on_camera_info(self, message: Any) -> None:
        if self.session is None:
            self.session = self.start(camera_of(message, self.is_rectified))

    def on_image(self, message: Any) -> None:
        self.latest = message

    def take(self) -> str:
        """Add the latest image, publish the next pose, and return a message. An image is added only once.

        **Raises:** `ValueError` as `image_of`, `matrix_of` and `Session.add` do.
        """
        if self.session is None or self.latest is None:
            return "there is no image yet"
        transform = self.lookup(self.latest.header.stamp)
        if transform is None:
            return "tf does not reach the image's time yet: call again"
        image, self.latest = self.latest, None
        depth, scale = image_of(image)
        self.session.add(depth, matrix_of(transform), depth_scale=scale)
        if (reason := self.session.done()) is not None:
            return f"done: {reason}"
        self.publish(self.session.next().matrix)
        return f"{len(self.session.views)} images"


def main() -> None:
    """Run the node. Its parameters are `world_frame`, `camera_frame`, `folder`, `is_rectified` (see `camera_of`), and
    `low` and `high`, two corners of the object's box."""
    import rclpy
    import tf2_ros
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from sensor_msgs.msg import CameraInfo, Image
    from std_srvs.srv import Trigger

    rclpy.init()
    node = Node("next_view")
    defaults = {"world_frame": "world", "camera_frame": "camera_optical_frame", "folder": "live", "is_rectified": False}
    world_frame, camera_frame, folder, is_rectified = (
        node.declare_parameter(name, value).value for name, value in defaults.items()
    )
    low, high = (
        tuple(node.declare_parameter(name, value).value)
        for name, value in (("low", [-0.15, -0.15, 0.005]), ("high", [0.15, 0.15, 0.30]))
    )
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer, node)
    publisher = node.create_publisher(PoseStamped, "next_view", 1)

    def publish(matrix: np.ndarray) -> None:
        message = PoseStamped()
        message.header.frame_id = world_frame
        message.header.stamp = node.get_clock().now().to_msg()
        write_pose(message.pose, matrix)
        publisher.publish(message)

    def start(camera: nbv.Camera) -> nbv.Session:
        search, rays = nbv.HalvingSearch(nbv.Reach()), nbv.Camera(height=24, width=32)
        planner = nbv.Planner(nbv.NewSurface(), search, rays, capacity=2000)
        return nbv.Session(camera, (low, high), planner, up="z", folder=folder, until=nbv.Covered(0.9))

    def lookup(stamp: Any) -> Any | None:
        try:
            return buffer.lookup_transform(world_frame, camera_frame, stamp).transform
        except tf2_ros.TransformException as problem:
            node.get_logger().warning(str(problem))
            return None

    bridge = Bridge(start, lookup, publish, is_rectified)

    def take(request: Any, response: Any) -> Any:
        try:
            response.message, response.success = bridge.take(), True
        except ValueError as problem:
            response.message, response.success = str(problem), False
        return response

    node.create_subscription(CameraInfo, "depth/camera_info", bridge.on_camera_info, 1)
    node.create_subscription(Image, "depth/image", bridge.on_image, 1)
    node.create_service(Trigger, "take", take)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
