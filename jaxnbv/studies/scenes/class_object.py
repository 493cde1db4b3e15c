"""Objects of several classes, with the part of their surface that tells the class."""

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
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.studies.scenes.labelled import LabelledSolid


class ClassObject(SignedDistance):
    """Base class: a solid of one of several classes.

    - `label`: index of its class.
    """

    label: eqx.AbstractVar[Int[Array, ""]]

    @property
    def class_label(self) -> Int[Array, ""]:
        return self.label

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Whether each point of the surface tells the class; here always True.

        - `x`: hits without noise.
        - `tolerance`: largest distance from the cue, in scene units.
        """
        return jnp.ones(x.shape[:-1], bool)


class SolidObject(ClassObject):
    """A solid of labelled primitives; a bound. Primitives of label 0 do not tell the class.

    - `solid`: the primitives, in scene coordinates.
    """

    solid: LabelledSolid
    label: Int[Array, ""]

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.solid(x)

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Whether each point lies on a primitive that tells the class."""
        return least_of_last(jnp.where(self.solid.labels > 0, self.solid.distances(x), jnp.inf)) <= tolerance


class ClassSet(NamedTuple):
    """Scenes of several classes.

    - `classes`: names of the classes.
    - `scene`: function from a split, an index and a framing to a scene; None if all scenes are meshes.
    """

    classes: tuple[str, ...]
    scene: Callable[..., ClassObject] | None = None


class ClassMesh(eqx.Module):
    """A mesh of one of several classes.

    - `label`: index of its class.
    - `part`: the triangles of `mesh` that tell the class; default: all.
    """

    mesh: TriangleMesh
    label: int
    part: TriangleMesh | None = None

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[np.ndarray, "*n"]:
        """Whether each point of the surface tells the class, see `ClassObject.on_cue`. Runs on the host."""
        if self.part is None:
            return np.ones(x.shape[:-1], bool)
        points = np.asarray(x, np.float64).reshape(-1, 3)
        distance = distance_to_triangles(points, self.part.vertices, self.part.faces)
        return (distance <= tolerance).reshape(x.shape[:-1])


def surface_of(thing: ClassObject | ClassMesh) -> Surface:
    """The surface of an object, for ray tracing."""
    return thing.mesh if isinstance(thing, ClassMesh) else SDFSurface(thing)


def scan_cue(thing: ClassObject | ClassMesh, camera: Camera, poses: Pose) -> tuple[Int[Array, " poses"], PointCloud]:
    """The number of rays from each pose that hit the cue of the class, and the scans without noise."""
    return _scan_telling(thing, camera, poses) if isinstance(thing, ClassMesh) else _compiled(thing, camera, poses)


def _scan_telling(
    thing: ClassObject | ClassMesh, camera: Camera, poses: Pose
) -> tuple[Int[Array, " poses"], PointCloud]:
    scans = scan(surface_of(thing), camera, poses)
    return jnp.sum(thing.on_cue(scans.points) & scans.mask, axis=-1), scans


_compiled = program(_scan_telling)


def hidden_view(
    thing: ClassObject | ClassMesh, key: PRNGKeyArray, camera: Camera = Camera(), poses: Pose | None = None
) -> Pose:
    """A random pose from which the object is visible but not the cue of its class.

    - `poses`: poses to draw from uniformly; default: the paper's 120.

    **Raises:** `ValueError` if there is no such pose.
    """
    poses = sphere_candidates(120) if poses is None else poses
    return poses[choose_hidden(*scan_cue(thing, camera, poses), key)]


def choose_hidden(cue_pixels: Int[AnyArray, " poses"], scans: PointCloud, key: PRNGKeyArray) -> int:
    """Index of a random pose whose scan hits the object but not the cue of its class, drawn uniformly.

    **Raises:** `ValueError` if there is no such pose.
    """
    hidden = np.flatnonzero((np.asarray(cue_pixels) == 0) & (np.asarray(scans.count) > 0))
    require(len(hidden) > 0, f"the cue of the class shows from all {len(cue_pixels)} candidates: ask for more of them")
    return int(jax.random.choice(key, hidden))
