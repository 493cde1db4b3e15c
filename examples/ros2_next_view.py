"""A thin ROS 2 node about a session: depth images in, the next pose of the camera out.

Topics: `depth/image` (sensor_msgs/Image, 16UC1 or mono16 in millimetres, 32FC1 in metres), `depth/camera_info`
(sensor_msgs/CameraInfo, with its distortion, region of interest and binning; a rectified stream has no distortion),
`next_view` (geometry_msgs/PoseStamped). The camera's pose is that of `camera_frame` in
`world_frame`, by tf at the image's time; camera frames of ROS look along z with y down, which is OpenCV's convention.
An image is taken in when the service `take` (std_srvs/Trigger) is called, since most of a stream shows nothing new.

What does not need ROS is in `Bridge`, which is tested with stand-ins for the messages; the node itself is not.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

import jaxnbv as nbv

_DTYPES = {"16UC1": (np.uint16, 1e-3), "mono16": (np.uint16, 1e-3), "32FC1": (np.float32, 1.0)}
# Models of sensor_msgs/CameraInfo that are OpenCV's; none where there is no distortion.
_MODELS = ("plumb_bob", "rational_polynomial", "")


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


def camera_of(message: Any) -> nbv.Camera:
    """The camera of a stream. The matrix and size of a message are those of the full image, of which the stream shows
    the region of interest, in full pixels, binned.

    **Raises:** `ValueError` for a distortion that is not OpenCV's, or a matrix of zeros, which means uncalibrated.
    """
    coefficients = tuple(message.d) if np.any(message.d) else ()
    if coefficients and message.distortion_model not in _MODELS:
        raise ValueError(f"the distortion is {message.distortion_model!r}: rectify the stream first (image_proc)")
    roi, matrix = message.roi, np.array(message.k, float).reshape(3, 3)
    binning = max(message.binning_x, 1), max(message.binning_y, 1)
    width, height = (roi.width or message.width) // binning[0], (roi.height or message.height) // binning[1]
    for row, (offset, factor) in enumerate(zip((roi.x_offset, roi.y_offset), binning, strict=True)):
        matrix[row] /= factor
        # The centre of the first binned pixel is in the middle of those that it stands for.
        matrix[row, 2] -= (offset + 0.5 * (factor - 1)) / factor
    return nbv.Camera.from_intrinsics(matrix, height, width, distortion=coefficients)


def matrix_of(transform: Any) -> np.ndarray:
    """The 4 x 4 matrix of a geometry_msgs/Transform."""
    x, y, z, w = (getattr(transform.rotation, name) for name in "xyzw")
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = [getattr(transform.translation, name) for name in "xyz"]
    return matrix


class Bridge:
    """Messages in, the next pose out.

    - `start`: makes the session, once the camera is known.
    - `lookup`: the transform of the camera in the world at a time stamp.
    - `publish`: what is to be done with the next pose, a 4 x 4 matrix, camera to world.
    """

    def __init__(
        self,
        start: Callable[[nbv.Camera], nbv.Session],
        lookup: Callable[[Any], Any],
        publish: Callable[[np.ndarray], None],
    ):
        self.start, self.lookup, self.publish = start, lookup, publish
        self.session: nbv.Session | None = None
        self.latest: Any = None

    def on_camera_info(self, message: Any) -> None:
        if self.session is None:
            self.session = self.start(camera_of(message))

    def on_image(self, message: Any) -> None:
        self.latest = message

    def take(self) -> str:
        """Take in the latest image and publish where to go next; says what was done."""
        if self.session is None or self.latest is None:
            return "there is no image yet"
        image, self.latest = self.latest, None
        depth, scale = image_of(image)
        self.session.add(depth, matrix_of(self.lookup(image.header.stamp)), depth_scale=scale)
        if (reason := self.session.done()) is not None:
            return f"done: {reason}"
        self.publish(self.session.next().matrix)
        return f"{len(self.session.views)} images"


def main() -> None:
    """Parameters of the node: world_frame, camera_frame, folder, and low and high, two corners of the object's box."""
    import rclpy
    import tf2_ros
    from geometry_msgs.msg import PoseStamped
    from rclpy.node import Node
    from sensor_msgs.msg import CameraInfo, Image
    from std_srvs.srv import Trigger

    rclpy.init()
    node = Node("next_view")
    world, camera, folder = (
        node.declare_parameter(name, value).value
        for name, value in (("world_frame", "world"), ("camera_frame", "camera_optical_frame"), ("folder", "live"))
    )
    low, high = (
        tuple(node.declare_parameter(name, value).value)
        for name, value in (("low", [-0.15, -0.15, 0.005]), ("high", [0.15, 0.15, 0.30]))
    )
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer, node)
    publisher = node.create_publisher(PoseStamped, "next_view", 1)

    def publish(matrix: np.ndarray) -> None:
        from scipy.spatial.transform import Rotation

        message = PoseStamped()
        message.header.frame_id = world
        for name, value in zip("xyz", matrix[:3, 3], strict=True):
            setattr(message.pose.position, name, float(value))
        for name, value in zip("xyzw", Rotation.from_matrix(matrix[:3, :3]).as_quat(), strict=True):
            setattr(message.pose.orientation, name, float(value))
        publisher.publish(message)

    def start(found: nbv.Camera) -> nbv.Session:
        search, rays = nbv.HalvingSearch(nbv.Reach()), nbv.Camera(height=24, width=32)
        planner = nbv.Planner(nbv.NewSurface(), search, rays, capacity=2000)
        return nbv.Session(found, (low, high), planner, up="z", folder=folder, until=nbv.Covered(0.9))

    bridge = Bridge(start, lambda stamp: buffer.lookup_transform(world, camera, stamp).transform, publish)

    def take(request: Any, response: Any) -> Any:
        response.message, response.success = bridge.take(), True
        return response

    node.create_subscription(CameraInfo, "depth/camera_info", bridge.on_camera_info, 1)
    node.create_subscription(Image, "depth/image", bridge.on_image, 1)
    node.create_service(Trigger, "take", take)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
