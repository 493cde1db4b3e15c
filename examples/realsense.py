"""Where to hold a RealSense camera next: `python examples/realsense.py`, in a clone, after
`pip install ".[report]" pyrealsense2`.

The depth stream's intrinsics and unit are read from the camera. How your robot or your hand is told to go somewhere,
and where it then truly is, you fill in: `go_to` takes and gives a 4 x 4 matrix, camera to world, in metres.
"""

import time

import numpy as np
import pyrealsense2 as rs

import jaxnbv as nbv

# In metres: two corners of a box about the object, without the table.
BOX = ((-0.15, -0.15, 0.005), (0.15, 0.15, 0.30))
# Frames that are read and left out after a move: those that the driver holds, and some by which the exposure settles.
STALE = 10
# A frame that is not newer than the move after so many more has a clock of its own.
MOST = 100


def go_to(matrix: np.ndarray) -> np.ndarray:
    """Hold the camera there, and say where it is."""
    input(f"hold the camera at\n{np.round(matrix, 3)}\nand press enter ")
    return matrix


def depth_camera(profile) -> tuple[nbv.Camera, float]:
    """The depth stream as a camera, and metres per unit of its images."""
    intrinsics = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
    matrix = [[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]]
    # Of a D435: nearer it measures nothing, farther nothing worth having.
    # The driver rectifies depth, so there is no distortion to undo.
    camera = nbv.Camera.from_intrinsics(matrix, intrinsics.height, intrinsics.width, nearest=0.2, farthest=2.0)
    return camera, profile.get_device().first_depth_sensor().get_depth_scale()


def taken_at(frame) -> float | None:
    """When a frame was taken, in seconds of the computer's clock; None where the driver has a clock of its own."""
    domain = getattr(frame, "get_frame_timestamp_domain", lambda: "hardware_clock")()
    return None if "hardware" in str(domain) else 1e-3 * frame.get_timestamp()


def depth_frame(pipeline, since: float):
    """The first depth frame that was taken after the camera came to rest; those before it are of other poses.

    - `since`: when it did, in seconds of the computer's clock.
    """
    for count in range(STALE + MOST):
        frame = pipeline.wait_for_frames().get_depth_frame()
        moment = taken_at(frame)
        if count >= STALE and (moment is None or moment > since):
            return frame
    raise RuntimeError(
        f"no frame is newer than {since:.3f} s: set the camera's global time (rs.option.global_time_enabled)"
    )


def main(folder: str = "live", views: int = 10) -> None:
    nbv.keep_compiled()
    pipeline = rs.pipeline()
    camera, scale = depth_camera(pipeline.start())
    planner = nbv.Planner(
        nbv.NewSurface(), nbv.HalvingSearch(nbv.Reach()), nbv.Camera(height=24, width=32), capacity=2000
    )
    session = nbv.Session(camera, BOX, planner, up="z", folder=folder, until=nbv.Covered(0.9))
    first = np.asarray(nbv.look_at((0.0, -0.4, 0.4), (0.0, 0.0, 0.15), up=(0.0, 0.0, 1.0)).matrix)
    try:
        while len(session.views) < views and not session.done():
            matrix = go_to(session.next().matrix if session.views else first)
            depth = np.asanyarray(depth_frame(pipeline, time.time()).get_data())
            session.add(depth, matrix, depth_scale=scale)
    finally:
        pipeline.stop()
    print(session.done() or f"{views} images are taken", nbv.write_report(session.episode, folder))


if __name__ == "__main__":
    main()
