"""Objects of several classes. The cue is the part of an object's surface that tells its class."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxnbv.checks import AnyArray, require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.programs import program
from jaxnbv.scanning import SDFSurface, Surface, TriangleMesh, scan
from jaxnbv.scanning.sdf import SignedDistance, least_of_last
from jaxnbv.scanning.sdf.sampled import distance_to_triangles
from jaxnbv.search import SphereCandidates
from jaxnbv.studies.scenes.labelled import LabelledSolid


class ClassObject(SignedDistance):
    """Base class of solids that belong to one of several classes. `label` is the index of the class."""

    label: eqx.AbstractVar[Int[Array, ""]]

    @property
    def class_label(self) -> Int[Array, ""]:
        return self.label

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Return whether each point lies on the cue, the part that tells the class. True if not overridden.

        - `x`: points on the surface without noise; `tolerance`: largest distance from the cue; both in scene units.
        """
        return jnp.ones(x.shape[:-1], bool)


class SolidObject(ClassObject):
    """A solid made of labelled primitives, in scene coordinates. Labels above 0 mark the cue.

    Called with points, it returns lower bounds of their signed distances, like a `LabelledSolid`.
    """

    solid: LabelledSolid
    label: Int[Array, ""]

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.solid(x)

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        return least_of_last(jnp.where(self.solid.labels > 0, self.solid.distances(x), jnp.inf)) <= tolerance


class ClassSet(NamedTuple):
    """Names of classes, and the procedural objects of these classes.

    - `scene`: function from split, index and framing to an object; None if all objects are meshes.
    """

    classes: tuple[str, ...]
    scene: Callable[..., ClassObject] | None = None


class ClassMesh(eqx.Module):
    """A mesh that belongs to one of several classes. `label` is the index of the class.

    - `cue`: the triangles of `mesh` that tell the class; default: all triangles.
    """

    mesh: TriangleMesh
    label: int
    cue: TriangleMesh | None = None

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[np.ndarray, "*n"]:
        """Return whether each point lies on the cue, the part that tells the class, see `ClassObject.on_cue`."""
        if self.cue is None:
            return np.ones(x.shape[:-1], bool)
        points = np.asarray(x, np.float64).reshape(-1, 3)
        distance = distance_to_triangles(points, self.cue.vertices, self.cue.faces)
        return (distance <= tolerance).reshape(x.shape[:-1])


def surface_of(class_object: ClassObject | ClassMesh) -> Surface:
    """Return the surface of an object for ray tracing."""
    return class_object.mesh if isinstance(class_object, ClassMesh) else SDFSurface(class_object)


def scan_cue(
    class_object: ClassObject | ClassMesh, camera: Camera, poses: Pose
) -> tuple[Int[Array, " poses"], PointCloud]:
    """Return the number of each pose's rays that hit the cue, and noiseless scans from the poses."""
    run = _scan_cue if isinstance(class_object, ClassMesh) else _scan_cue_compiled
    return run(class_object, camera, poses)


def _scan_cue(
    class_object: ClassObject | ClassMesh, camera: Camera, poses: Pose
) -> tuple[Int[Array, " poses"], PointCloud]:
    scans = scan(surface_of(class_object), camera, poses)
    return jnp.sum(class_object.on_cue(scans.points) & scans.mask, axis=-1), scans


_scan_cue_compiled = program(_scan_cue)


def hidden_view(
    class_object: ClassObject | ClassMesh, key: PRNGKeyArray, camera: Camera = Camera(), poses: Pose | None = None
) -> Pose:
    """Return a random pose that shows the object but not its cue (the part that tells the class).

    - `poses`: poses from which the result is drawn uniformly; default: the paper's 120 candidates.

    **Raises:** `ValueError` if there is no such pose.
    """
    poses = SphereCandidates(120).poses() if poses is None else poses
    return poses[choose_hidden(*scan_cue(class_object, camera, poses), key)]


def choose_hidden(cue_pixels: Int[AnyArray, " poses"], scans: PointCloud, key: PRNGKeyArray) -> int:
    """Return the index of a random pose whose scan hits the object but not its cue, drawn uniformly.

    - `cue_pixels`, `scans`: for each pose, the number of rays that hit the cue, and the scan.

    **Raises:** `ValueError` if there is no such pose.
    """
    indices = np.flatnonzero((np.asarray(cue_pixels) == 0) & (np.asarray(scans.count) > 0))
    require(len(indices) > 0, f"the cue of the class shows from all {len(cue_pixels)} candidates: ask for more of them")
    return int(jax.random.choice(key, indices))
