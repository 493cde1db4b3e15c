"""Objects whose class is asked for."""

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
from jaxnbv.scanning import SDFSurface, Surface, TriangleMesh, scan
from jaxnbv.scanning.sdf import SignedDistance, least_of_last
from jaxnbv.scanning.sdf.sampled import distance_to_triangles
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.studies.scenes.labelled import LabelledSolid


class ClassObject(SignedDistance):
    """A solid of one of several classes.

    - `label`: which, from 0.
    """

    label: eqx.AbstractVar[Int[Array, ""]]

    @property
    def class_label(self) -> Int[Array, ""]:
        return self.label

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Which points of the surface tell the class: here all.

        Give hits without noise; the tolerance is in scene units.
        """
        return jnp.ones(x.shape[:-1], bool)


class SolidObject(ClassObject):
    """Labelled primitives; a bound. Those of label 0 say nothing of the class, all others tell it.

    - `solid`: where it stands in the scene.
    """

    solid: LabelledSolid
    label: Int[Array, ""]

    def __call__(self, x: Float[AnyArray, "*n 3"]) -> Float[Array, "*n"]:
        return self.solid(x)

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Those of the primitives that tell the class."""
        return least_of_last(jnp.where(self.solid.labels > 0, self.solid.distances(x), jnp.inf)) <= tolerance


class ClassSet(NamedTuple):
    """Scenes of several classes.

    - `classes`: their names.
    - `scene`: of a split, an index and a framing; None where meshes alone are such scenes.
    """

    classes: tuple[str, ...]
    scene: Callable[..., ClassObject] | None = None


class ClassMesh(eqx.Module):
    """A mesh of one of several classes.

    - `label`: which, from 0.
    - `part`: the triangles that tell the class, of `mesh`; default: all.
    """

    mesh: TriangleMesh
    label: int
    part: TriangleMesh | None = None

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[np.ndarray, "*n"]:
        """As of a `ClassObject`; on the host."""
        if self.part is None:
            return np.ones(x.shape[:-1], bool)
        points = np.asarray(x, np.float64).reshape(-1, 3)
        distance = distance_to_triangles(points, self.part.vertices, self.part.faces)
        return (distance <= tolerance).reshape(x.shape[:-1])


def surface_of(thing: ClassObject | ClassMesh) -> Surface:
    """What rays hit."""
    return thing.mesh if isinstance(thing, ClassMesh) else SDFSurface(thing)


def scan_cue(thing: ClassObject | ClassMesh, camera: Camera, poses: Pose) -> tuple[Int[Array, " poses"], PointCloud]:
    """How many rays of each pose hit the cue of the class, and the scans, without noise."""
    return _scan_telling(thing, camera, poses) if isinstance(thing, ClassMesh) else _compiled(thing, camera, poses)


def _scan_telling(
    thing: ClassObject | ClassMesh, camera: Camera, poses: Pose
) -> tuple[Int[Array, " poses"], PointCloud]:
    scans = scan(surface_of(thing), camera, poses)
    return jnp.sum(thing.on_cue(scans.points) & scans.mask, axis=-1), scans


_compiled = eqx.filter_jit(_scan_telling)


def hidden_view(
    thing: ClassObject | ClassMesh, key: PRNGKeyArray, camera: Camera = Camera(), poses: Pose | None = None
) -> Pose:
    """A pose from which the object shows but not the cue of its class, drawn uniformly.

    - `poses`: from which it is drawn, by default the paper's 120.

    **Raises:** `ValueError` if there is none.
    """
    poses = sphere_candidates(120) if poses is None else poses
    return poses[choose_hidden(*scan_cue(thing, camera, poses), key)]


def choose_hidden(cue_pixels: Int[AnyArray, " poses"], scans: PointCloud, key: PRNGKeyArray) -> int:
    """Index of a pose whose scan hits the object but not the cue of its class, drawn uniformly from them.

    **Raises:** `ValueError` if there is none.
    """
    hidden = np.flatnonzero((np.asarray(cue_pixels) == 0) & (np.asarray(scans.count) > 0))
    require(len(hidden) > 0, f"the cue of the class shows from all {len(cue_pixels)} candidates: ask for more of them")
    return int(jax.random.choice(key, hidden))
