"""An object whose class is asked for."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnbv.camera import Camera
from jaxnbv.checks import AnyArray
from jaxnbv.cloud import PointCloud
from jaxnbv.pose import Pose
from jaxnbv.scanning import SDFSurface, scan
from jaxnbv.scanning.sdf import SignedDistance


class ClassObject(SignedDistance):
    """A solid of one of several classes.

    - `label`: which, from 0.
    """

    label: eqx.AbstractVar[Int[Array, ""]]

    def tells(self, x: Float[AnyArray, "*n 3"], tolerance: float = 2e-3) -> Bool[Array, "*n"]:
        """Which points of the surface tell the class: here all.

        Give hits without noise; the tolerance is in scene units.
        """
        return jnp.ones(x.shape[:-1], bool)


@eqx.filter_jit
def scan_telling(thing: ClassObject, camera: Camera, poses: Pose) -> tuple[Int[Array, " poses"], PointCloud]:
    """How many rays of each pose hit what tells the class, and the scans, without noise."""
    scans = scan(SDFSurface(thing), camera, poses)
    return jnp.sum(thing.tells(scans.points) & scans.mask, axis=-1), scans
