"""The common viewpoint of an episode's pictures, and the places at which its cameras are drawn."""

import equinox as eqx
import numpy as np
import trimesh
from jaxtyping import Float

from jaxnbv.geometry.pose import Pose, fibonacci_sphere
from jaxnbv.planning.episode import Episode
from jaxnbv.scanning.triangle_rays import first_faces
from jaxnbv.viz.sphere import unit

# Depth of drawn fields of view, in radii of the object. A field of view ends at this multiple of the object's extent in
# the direction of the camera. Least value of this extent, in radii.
_FRUSTUM_DEPTH, _END_DISTANCE, _MIN_EXTENT = 0.2, 1.06, 0.35
_RADIUS_PERCENTILE, _MAX_OUTLINE_POINTS = 99.0, 1000
_NUM_DIRECTIONS, _MAX_HEIGHT = 80, 0.8
# Number of points whose visibility is tested, and distance in front of them at which test rays start, in radii.
_NUM_TESTED, _CLEARANCE = 300, 0.05
# A camera nearer to the line of sight than this (cosine) would stand in front of the object.
_MIN_COSINE = 0.9


class Viewpoint(eqx.Module):
    """One viewpoint for all pictures, near enough for the object to fill them.

    - `eye`: unit vector from the origin to the viewer.
    - `radius`, `outline`: radius of the object about the origin, in scene units, and points on the object.
    - `depth`: depth to which fields of view are drawn, in scene units.
    """

    eye: Float[np.ndarray, "3"]
    radius: float
    outline: Float[np.ndarray, "n 3"]
    depth: float

    @property
    def extent(self) -> float:
        """Radius of the pictures' content in scene units, including the numbers of the cameras."""
        return 1.1 * (_END_DISTANCE * self.radius + self.depth)

    def drawn_pose(self, pose: Pose) -> Pose:
        """Return the pose at which to draw a camera: moved toward the origin until just outside the object."""
        position = np.asarray(pose.position, np.float64)
        distance = max(float(np.linalg.norm(position)), 1e-9)
        extent = max(float((self.outline @ position).max()) / distance, _MIN_EXTENT * self.radius)
        return Pose(pose.rotation, min(1.0, (_END_DISTANCE * extent + self.depth) / distance) * pose.position)


def viewpoint_of(episode: Episode, surfaces: list[trimesh.Trimesh]) -> Viewpoint:
    """Choose the viewpoint of an episode's pictures. `surfaces`: those shown, in the order of views."""
    outlines = episode.cloud.to_numpy()[0], *(np.asarray(surface.vertices) for surface in surfaces)
    samples = [np.asarray(rows, np.float64)[:: max(1, len(rows) // _MAX_OUTLINE_POINTS)] for rows in outlines]
    distances = [np.linalg.norm(rows, axis=1) for rows in samples]
    radius = max(float(np.percentile(lengths, _RADIUS_PERCENTILE)) for lengths in distances)
    outline = np.concatenate([rows[lengths <= radius] for rows, lengths in zip(samples, distances, strict=True)])
    cameras = np.stack([np.asarray(view.pose.position, np.float64) for view in episode.views])
    eyes = np.asarray(fibonacci_sphere(_NUM_DIRECTIONS), np.float64)
    eyes = eyes[np.abs(eyes[:, 1]) < _MAX_HEIGHT]
    visibility = _visible_fraction(episode, surfaces[-1] if surfaces else None, eyes, _CLEARANCE * radius)
    # Cameras should not stand between the eye and the object.
    in_front = np.mean(unit(cameras) @ eyes.T > _MIN_COSINE, axis=0)
    return Viewpoint(eyes[int(np.argmax(visibility - in_front))], radius, outline, _FRUSTUM_DEPTH * radius)


def _visible_fraction(
    episode: Episode, surface: trimesh.Trimesh | None, eyes: Float[np.ndarray, "e 3"], clearance: float
) -> Float[np.ndarray, " e"]:
    """Return, for each of `eyes`, the fraction of the chosen views' points that are visible from there.

    A point is visible if its normal faces the eye and the surface does not hide it.

    - `eyes`: unit vectors from the origin toward possible viewers.
    - `clearance`: distance in front of a point at which the ray to the viewer starts.
    """
    first, *later = (view.scan.to_numpy() for view in episode.views)
    scans = [scan for scan in later if len(scan[0])] or [first]
    points, normals = (np.concatenate(rows).astype(np.float64) for rows in zip(*scans, strict=True))
    indices = np.linspace(0, len(points) - 1, min(_NUM_TESTED, len(points))).astype(int)
    is_facing = normals[indices] @ eyes.T > 0.2
    if surface is not None and len(indices):
        rays = np.repeat(eyes[None], len(indices), axis=0)
        origins = points[indices, None] + clearance * rays
        rows, _ = first_faces(surface.vertices, surface.faces)(origins.reshape(-1, 3), rays.reshape(-1, 3))
        is_facing &= (rows < 0).reshape(is_facing.shape)
    return np.sum(is_facing, axis=0) / max(len(indices), 1)
