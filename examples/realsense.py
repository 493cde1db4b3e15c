"""Scan an object with a RealSense camera: `python examples/realsense.py`, in a clone, after
`pip install ".[report]" pyrealsense2`. On Linux pyrealsense2 also needs libusb: `apt install libusb-1.0-0`.

The example reads the intrinsics and the unit of depth from the camera. You write `go_to` for your robot or your hand:
it moves the camera and returns the pose where the camera then stands, a 4 x 4 matrix, camera to world, in metres.

`tests/planning/test_realsense.py` runs it with the frames of librealsense's software device. It has not run with a
camera.
"""

import threading
import time

import numpy as np
import pyrealsense2 as rs

import jaxnbv as nbv

# Two corners of a box about the object, without the table, in metres.
BOX = ((-0.15, -0.15, 0.005), (0.15, 0.15, 0.30))
# Frames to skip after a move: the driver still holds some of them, and the exposure settles during the others.
NUM_SKIPPED = 10
# The camera's clock disagrees with the computer's if this many further frames are all older than the move.
MAX_OLD = 100


def go_to(matrix: np.ndarray) -> np.ndarray:
    """Move the camera to a pose and return the pose that it reached."""
    input(f"hold the camera at\n{np.round(matrix, 3)}\nand press enter ")
    return matrix


def depth_camera(profile: rs.pipeline_profile) -> tuple[nbv.Camera, float]:
    """The depth stream as a camera, and metres per unit of its images.

    **Raises:** `ValueError` for a lens model that is not OpenCV's.
    """
    intrinsics = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
    matrix = [[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]]
    # Cameras of the D400 series rectify depth: their coefficients are zeros.
    distortion = tuple(intrinsics.coeffs) if any(intrinsics.coeffs) else ()
    if distortion and intrinsics.model != rs.distortion.brown_conrady:
        raise ValueError(f"the depth stream has a lens of {intrinsics.model}: undistort its images first")
    # A D435 measures nothing nearer than 0.2 m, and is too noisy beyond 2 m.
    camera = nbv.Camera.from_intrinsics(
        matrix, intrinsics.height, intrinsics.width, nearest=0.2, farthest=2.0, distortion=distortion
    )
    return camera, profile.get_device().first_depth_sensor().get_depth_scale()


def capture_time(frame: rs.depth_frame) -> float | None:
    """When a frame was taken, in seconds of the computer's clock; None if the camera stamps frames by its own clock."""
    if frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
        return None
    return 1e-3 * frame.get_timestamp()


def depth_frame(pipeline: rs.pipeline, since: float) -> rs.depth_frame:
    """The first depth frame that was taken after a move. Earlier frames show the view from another pose.

    - `since`: end of the move, in seconds of the computer's clock.

    **Raises:** `RuntimeError` if no frame is newer.
    """
    for count in range(NUM_SKIPPED + MAX_OLD):
        frame = pipeline.wait_for_frames().get_depth_frame()
        seconds = capture_time(frame)
        if count >= NUM_SKIPPED and (seconds is None or seconds > since):
            return frame
    raise RuntimeError(
        f"no frame is newer than {since:.3f} s: set the camera's global time (rs.option.global_time_enabled)"
    )


def main(
    folder: str = "live",
    views: int = 10,
    pipeline: rs.pipeline | None = None,
    planner: nbv.Planner | None = None,
) -> None:
    """Take images until the object is covered, and write a report.

    - `pipeline`: streams depth; by default from the first camera that librealsense lists.
    - `planner`: by default looks for new surface among the poses of `nbv.Reach`.
    """
    nbv.keep_compiled()
    if planner is None:
        search, rays = nbv.HalvingSearch(nbv.Reach()), nbv.Camera(height=24, width=32)
        planner = nbv.Planner(nbv.NewSurface(), search, rays, capacity=2000)
    first = np.asarray(nbv.look_at((0.0, -0.4, 0.4), (0.0, 0.0, 0.15), up=(0.0, 0.0, 1.0)).matrix)
    pipeline, config = rs.pipeline() if pipeline is None else pipeline, rs.config()
    # The default configuration streams colour too, which only takes bandwidth.
    config.enable_stream(rs.stream.depth)
    profile = pipeline.start(config)
    try:
        camera, scale = depth_camera(profile)
        session = nbv.Session(camera, BOX, planner, up="z", folder=folder, until=nbv.Covered(0.9))
        if not session.views:
            # It compiles while the camera goes to its first pose.
            threading.Thread(target=session.rehearse).start()
        while len(session.views) < views and not session.done():
            matrix = go_to(session.next().matrix if session.views else first)
            depth = np.asanyarray(depth_frame(pipeline, time.time()).get_data())
            session.add(depth, matrix, depth_scale=scale)
    finally:
        pipeline.stop()
    print(session.done() or f"{views} images are taken", nbv.write_report(session.episode, folder))


if __name__ == "__main__":
    main()
