"""Objects whose class is asked for."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.checks import AnyArray
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning import SDFSurface, Surface, TriangleMesh, scan
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.scanning.triangles import distance_to_triangles


class ClassObject(SignedDistance):
    """A solid of one of several classes.

    - `label`: which, from 0.
    """

    label: eqx.AbstractVar[Int[Array, ""]]

    def on_cue(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Which points of the surface tell the class: here all.

        Give hits without noise; the tolerance is in scene units.
        """
        return jnp.ones(x.shape[:-1], bool)


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
