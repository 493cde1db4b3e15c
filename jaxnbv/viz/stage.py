"""The viewpoint of all pictures of an episode, and the places at which its cameras are drawn."""

import equinox as eqx
import numpy as np
import trimesh
from jaxtyping import Float

from jaxnbv.geometry.pose import Pose, fibonacci_sphere
from jaxnbv.planning.episode import Episode
from jaxnbv.scanning.triangle_rays import first_faces
from jaxnbv.viz.sphere import unit

# Depth of drawn fields of view in radii of the object. Distance from the origin at which they end, in extents of the
# object in this direction, and least value of this extent in radii.
_DEPTH, _STAND, _CLOSEST = 0.2, 1.06, 0.35
_SPREAD, _OUTLINE = 99.0, 1000
_DIRECTIONS, _HIGHEST = 80, 0.8
# Number of points whose visibility is tested, and start of the test rays in front of them, in radii.
_SEEN, _CLEAR = 300, 0.05
# A camera nearer to the line of sight than this (cosine) would stand in front of the object.
_IN_FRONT = 0.9


class Stage(eqx.Module):
    """One viewpoint for all pictures, near enough for the object to fill them.

    - `eye`: unit vector from the origin to the viewer.
    - `radius`: radius of the object about the origin, in scene units.
    - `outline`: points on the object.
    - `depth`: depth to which fields of view are drawn, in scene units.
    """

    eye: Float[np.ndarray, "3"]
    radius: float
    outline: Float[np.ndarray, "n 3"]
    depth: float

    @property
    def extent(self) -> float:
        """Radius of the pictures' content in scene units, including the numbers of the cameras."""
        return 1.1 * (_STAND * self.radius + self.depth)

    def pulled(self, pose: Pose) -> Pose:
        """Return the pose at which to draw a camera: moved toward the origin, until just outside the object."""
        position = np.asarray(pose.position, np.float64)
        distance = max(float(np.linalg.norm(position)), 1e-9)
        extent = max(float((self.outline @ position).max()) / distance, _CLOSEST * self.radius)
        return Pose(pose.rotation, min(1.0, (_STAND * extent + self.depth) / distance) * pose.position)


def stage_of(episode: Episode, surfaces: list[trimesh.Trimesh]) -> Stage:
    """Choose the viewpoint of an episode's pictures. `surfaces`: surfaces to show, in the order of views."""
    outlines = episode.cloud.to_numpy()[0], *(np.asarray(surface.vertices) for surface in surfaces)
    samples = [np.asarray(rows, np.float64)[:: max(1, len(rows) // _OUTLINE)] for rows in outlines]
    distances = [np.linalg.norm(rows, axis=1) for rows in samples]
    radius = max(float(np.percentile(far, _SPREAD)) for far in distances)
    outline = np.concatenate([rows[far <= radius] for rows, far in zip(samples, distances, strict=True)])
    cameras = np.stack([np.asarray(view.pose.position, np.float64) for view in episode.views])
    eyes = np.asarray(fibonacci_sphere(_DIRECTIONS), np.float64)
    eyes = eyes[np.abs(eyes[:, 1]) < _HIGHEST]
    visible = _shown(episode, surfaces[-1] if surfaces else None, eyes, _CLEAR * radius)
    # Cameras should not stand between the eye and the object.
    in_front = np.mean(unit(cameras) @ eyes.T > _IN_FRONT, axis=0)
    return Stage(eyes[int(np.argmax(visible - in_front))], radius, outline, _DEPTH * radius)


def _shown(
    episode: Episode, surface: trimesh.Trimesh | None, eyes: Float[np.ndarray, "e 3"], clear: float
) -> Float[np.ndarray, " e"]:
    """Return, for each viewing direction in `eyes`, the fraction of points that it shows.

    The points are those of the chosen views. They must face the viewer and not be hidden by the surface.

    - `clear`: distance in front of a point at which the ray to the viewer starts.
    """
    first, *chosen = (view.scan.to_numpy() for view in episode.views)
    scans = [scan for scan in chosen if len(scan[0])] or [first]
    points, normals = (np.concatenate(rows).astype(np.float64) for rows in zip(*scans, strict=True))
    few = np.linspace(0, len(points) - 1, min(_SEEN, len(points))).astype(int)
    facing = normals[few] @ eyes.T > 0.2
    if surface is not None and len(few):
        rays = np.repeat(eyes[None], len(few), axis=0)
        origins = points[few, None] + clear * rays
        rows, _ = first_faces(surface.vertices, surface.faces)(origins.reshape(-1, 3), rays.reshape(-1, 3))
        facing &= (rows < 0).reshape(facing.shape)
    return np.sum(facing, axis=0) / max(len(few), 1)
