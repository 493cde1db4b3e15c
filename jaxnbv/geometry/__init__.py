"""Poses, cameras, clouds, frames and boxes."""

from jaxnbv.geometry.camera import Camera as Camera
from jaxnbv.geometry.cloud import PointCloud as PointCloud
from jaxnbv.geometry.cloud import concatenate as concatenate
from jaxnbv.geometry.cloud import farthest_point_subsample as farthest_point_subsample
from jaxnbv.geometry.frame import Frame as Frame
from jaxnbv.geometry.neighbours import NearestPoints as NearestPoints
from jaxnbv.geometry.neighbours import nearest_squared_distance as nearest_squared_distance
from jaxnbv.geometry.normals import estimate_normals as estimate_normals
from jaxnbv.geometry.pose import Pose as Pose
from jaxnbv.geometry.pose import fibonacci_sphere as fibonacci_sphere
from jaxnbv.geometry.pose import look_at as look_at
from jaxnbv.geometry.volume import Box as Box
