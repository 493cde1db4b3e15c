"""How well placed parts explain what every ray of every view came back with, and what follows for their weights.

A part h, where it is placed, has a depth image z_h from the pose of each view. Its misfit is a sum over rays,

    L_h = sum over views and rays of  log(1 + (cos dz)^2 / 2 tau^2)   where the ray met the object and h, dz apart,
                                      C     where it met the object and not h, or saw through h,
                                      C_0   where h faces the ray and nothing came back,

no term more than C = log(1 + c^2 / 2 tau^2), c = 0.3: one that is far off says no more than one that is off. The sum,
and not a mean, lets evidence add up; rays side by side err together, so it is tempered,

    w_h proportional to exp(-kappa L_h),   w_0 (none of these) to exp(-kappa N e_0),   N the rays that met the object.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.scanning import SDFSurface, scan
from jaxnbv.scanning.sdf import SignedDistance
from jaxnbv.surfaces.placement import Placement
from jaxnbv.surfaces.registration import Hypotheses
from jaxnbv.surfaces.shape_bank import ShapeBank

# Scene units.
_TAU, _FAR = 0.03, 0.3
MOST = math.log1p(_FAR**2 / (2.0 * _TAU**2))
# A surface that faces a ray returns it with a probability of 0.7 or more.
_NO_RETURN = -math.log(0.3)
# The least cosine of incidence at which a return is expected.
_STEEP = 0.5
# Rays of a view that are compared, at most.
NUM_RAYS = 1_000
KAPPA, NONE_MISFIT = 0.1, 0.8


class Placed(SignedDistance):
    """A solid where a placement puts it."""

    solid: SignedDistance
    placement: Placement

    def __call__(self, x):
        return self.placement.distance(self.solid, x)


class RangeImage(eqx.Module):
    """What rays meet, as a sensor says it or as it is expected of a placed part.

    - `reach`: how far each ray goes: to what it met, without end where nothing came back, zero where nothing is known.
    - `is_object`: whether what it met is the object.
    - `cosine`: of the angle of incidence on the object; one where it is not known.
    """

    reach: Float[Array, "*batch rays"]
    is_object: Bool[Array, "*batch rays"]
    cosine: Float[Array, "*batch rays"]

    @classmethod
    def of(cls, scans: PointCloud, poses: Pose) -> "RangeImage":
        """Of scans of a part alone, one from each of a batch of poses."""
        offset = scans.points - poses.position[..., None, :]
        away = jnp.linalg.norm(offset, axis=-1)
        cosine = jnp.abs(jnp.sum(offset * scans.normals, axis=-1)) / jnp.where(scans.mask, away, 1.0)
        return cls(jnp.where(scans.mask, away, jnp.inf), scans.mask, jnp.where(scans.mask, cosine, 1.0))


def misfits(measured: RangeImage, expected: RangeImage) -> Float[Array, "*batch rays"]:
    """The misfit of each ray: what an expected image fails to explain of a measured one."""
    both = measured.is_object & expected.is_object
    apart = jnp.where(both, measured.reach, 0.0) - jnp.where(both, expected.reach, 0.0)
    near = jnp.log1p((apart * expected.cosine) ** 2 / (2.0 * _TAU**2))
    returned, known = jnp.isfinite(measured.reach), measured.reach > 0
    through = expected.is_object & ~measured.is_object & returned & (expected.reach < measured.reach - 2.0 * _TAU)
    silent = expected.is_object & ~returned & (expected.cosine >= _STEEP)
    missing = measured.is_object & ~expected.is_object
    costs = jnp.where(
        both, jnp.minimum(near, MOST), jnp.where(through | missing, MOST, jnp.where(silent, _NO_RETURN, 0.0))
    )
    return jnp.where(known, costs, 0.0)


@eqx.filter_jit
def evidence(
    bank: ShapeBank, hypotheses: Hypotheses, observations: Observations
) -> tuple[Float[Array, " h"], Float[Array, ""]]:
    """L of each hypothesis, and N; zeros where no looks are kept."""
    looks, views = observations.looks, observations.poses
    if looks is None:
        return jnp.zeros_like(hypotheses.misfit), jnp.zeros((), hypotheses.misfit.dtype)
    stride = math.ceil(math.sqrt(looks.camera.num_rays / NUM_RAYS))
    camera, rows = looks.camera.strided(stride), slice(stride // 2, None, stride)
    images = looks.sight.reshape(-1, looks.camera.height, looks.camera.width)[:, rows, rows]
    images = images.reshape(images.shape[0], -1)
    solids = jax.vmap(Placed)(bank.shape(hypotheses.shape).solid, hypotheses.placement)

    def add(index, total):
        pose = jax.tree.map(lambda leaf: leaf[index], views.rows)
        origins, directions = camera.rays(pose)
        sight = images[index]
        met = jnp.isfinite(sight) & (sight > 0)
        points = origins + jnp.where(met, sight, 0.0)[:, None] * directions
        is_object = met & (looks(points) <= looks.grid.spacing)
        measured = RangeImage(sight, is_object, jnp.ones_like(sight))

        def of_part(solid):
            return jnp.sum(misfits(measured, RangeImage.of(scan(SDFSurface(solid), camera, pose), pose)))

        sums, count = total
        return sums + jax.lax.map(of_part, solids, batch_size=8), count + jnp.sum(is_object)

    zero = jnp.zeros_like(hypotheses.misfit), jnp.zeros((), hypotheses.misfit.dtype)
    return jax.lax.fori_loop(0, views.count, add, zero)
