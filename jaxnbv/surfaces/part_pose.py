"""The world pose of the most likely part, its covariance, and equivalent poses of a symmetric part."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxnbv.geometry.frame import Frame
from jaxnbv.observations import Observations
from jaxnbv.programs import program
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.surfaces.part_search import TOLERANCE
from jaxnbv.surfaces.placement import Placement
from jaxnbv.surfaces.registration import FitTargets
from jaxnbv.surfaces.shape_bank import Shape, values_and_gradients

_NUM_PROBES = 4096
# Step between the rotation angles about each axis that are tested as symmetries of a part.
_ANGLE_STEP = np.radians(5.0)
# Prior standard deviations of a rotation (radians) and a shift (scene units). They matter in directions that the points
# do not constrain.
_ROTATION_DEVIATION, _SHIFT_DEVIATION = np.pi / np.sqrt(3.0), 1.0
# Smallest error of the points in scene units, the accuracy of a part's surface on its grid. Standard deviation of a
# normal distribution divided by the median of its absolute value.
_MIN_ERROR, _ERROR_PER_MEDIAN = 0.005, 1.4826


class ObjectPose(eqx.Module):
    """World pose of a part.

    - `matrix`: rigid motion from the coordinates of the part's mesh, in world units, to the world.
    - `covariance`: joint covariance of the rotation vector about the part's centre (radians, world axes) and of the
      centre's position (world units), if the object is this part. It comes from the errors of the points.
    - `alternatives`: all equivalent matrices of a symmetric part, starting with `matrix`. A part that is round about an
      axis has 72 alternatives, five degrees apart, or 144 if its two ends are equal.
    """

    name: str
    matrix: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    alternatives: Float[np.ndarray, "n 4 4"]


def object_pose(hypotheses: PartHypotheses, observations: Observations, frame: Frame) -> ObjectPose:
    """Return the world pose of the most likely part. `frame` maps the world to the scene."""
    part, placement = hypotheses.most_likely
    bank = hypotheses.bank
    shape = bank.shape(jnp.asarray(part))
    from_mesh = np.eye(4) if bank.from_mesh is None else np.asarray(bank.from_mesh[part], np.float64)
    to_scene = _matrix(np.asarray(placement.rotation), np.asarray(placement.shift))
    to_world = np.linalg.inv(_matrix(frame.scale * frame.rotation, -frame.scale * frame.rotation @ frame.center))
    rotations = symmetries(shape)
    matrices = np.stack([_make_rigid(to_world @ to_scene @ _matrix(one, np.zeros(3)) @ from_mesh) for one in rotations])
    covariance = _covariance(shape, placement, FitTargets.of(observations))
    jacobian = np.kron(np.eye(2), frame.rotation.T) * np.repeat([1.0, 1.0 / frame.scale], 3)[:, None]
    return ObjectPose(bank.names[part], matrices[0], jacobian @ covariance @ jacobian.T, matrices)


def surface_error(hypotheses: PartHypotheses, observations: Observations) -> float:
    """Return the expected error (root mean square, scene units) of the surface of the most likely part.

    The mean square over points of the surface has two terms: the variance due to errors of the scanned points, and the
    squared distance to the surfaces of the hypotheses, averaged with their probabilities.
    """
    part, placement = hypotheses.most_likely
    shape = hypotheses.bank.shape(jnp.asarray(part))
    covariance = _covariance(shape, placement, FitTargets.of(observations))
    points = np.asarray(placement.rotation) @ np.asarray(shape.extremes).T + np.asarray(placement.shift)[:, None]
    surface = jnp.asarray(points.T, jnp.float32)
    distances = np.asarray(distances_to(hypotheses, surface), np.float64)
    _, gradient = _distances(shape, placement, surface)
    # Only motion along the normal counts. Motion along the surface leaves the surface in place.
    normals = np.asarray(gradient, np.float64)
    rows = np.concatenate([np.cross(normals, points.T - np.asarray(placement.shift)), -normals], axis=1)
    pose_variance = float(np.mean(np.einsum("ni,ij,nj->n", rows, covariance, rows)))
    hypothesis_variance = float(np.asarray(hypotheses.weights, np.float64)[:-1] @ np.mean(distances**2, axis=1))
    return float(np.sqrt(pose_variance + hypothesis_variance))


@program
def distances_to(hypotheses: PartHypotheses, points: Float[Array, "p 3"]) -> Float[Array, "h p"]:
    """Return the signed distances of points to the placed part of each hypothesis."""
    solids = hypotheses.bank.shape(hypotheses.placed.shape).solid
    return jax.lax.map(lambda part: part[1].distance(part[0], points), (solids, hypotheses.placed.placement))


@program
def _distances(
    shape: Shape, placement: Placement, points: Float[Array, "p 3"]
) -> tuple[Float[Array, " p"], Float[Array, "p 3"]]:
    """Return the signed distances of points to a placed shape, and their gradients."""
    return values_and_gradients(lambda x: placement.distance(shape.solid, x), points)


def symmetries(shape: Shape) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotations about a shape's centre that leave the shape unchanged, the identity first.

    Two sets of rotations are tested: multiples of five degrees about each axis, and the rotations of a cube onto
    itself. The result contains the products of a symmetry from the first set and a symmetry from the second.
    """
    vectors = [angle * axis for axis in np.eye(3) for angle in np.arange(0.0, 2.0 * np.pi, _ANGLE_STEP)]
    about_axes, of_cube = Rotation.from_rotvec(vectors).as_matrix(), Rotation.create_group("O").as_matrix()
    rotations = np.concatenate([about_axes, of_cube])
    half_side = 1.1 * float(jnp.max(jnp.linalg.norm(shape.extremes, axis=-1)))
    probes = half_side * (2.0 * np.random.default_rng(0).random((_NUM_PROBES, 3)) - 1.0)
    change = _max_change(shape, jnp.asarray(rotations, shape.extremes.dtype), jnp.asarray(probes, shape.extremes.dtype))
    is_symmetry = np.asarray(change) < TOLERANCE
    axial, cubic = about_axes[is_symmetry[: len(about_axes)]], of_cube[is_symmetry[len(about_axes) :]]
    # Products need no test, because a product of two symmetries is a symmetry.
    products = np.concatenate([np.eye(3)[None], np.einsum("aij,bjk->abik", axial, cubic).reshape(-1, 3, 3)])
    _, rows = np.unique(np.round(products, 6).reshape(-1, 9) + 0.0, axis=0, return_index=True)
    return products[np.sort(rows)]


@program
def _max_change(shape: Shape, rotations: Float[Array, "n 3 3"], probes: Float[Array, "p 3"]) -> Float[Array, " n"]:
    distances = shape.solid(probes)

    def change(rotation):
        return jnp.max(jnp.abs(shape.solid(jnp.matmul(probes, rotation.T, precision="highest")) - distances))

    return jax.lax.map(change, rotations)


def _covariance(shape: Shape, placement: Placement, targets: FitTargets) -> Float[np.ndarray, "6 6"]:
    """Return the joint covariance of rotation about the part's centre (radians) and shift (scene units).

    It is (J^T J / s^2 + P)^-1, where J is the derivative of the distances from the points to the part, s the standard
    deviation of these distances, and P the precision of a broad prior.
    """
    distance, gradient = _distances(shape, placement, targets.points)
    mask = np.asarray(targets.mask)
    distance, gradient = np.asarray(distance, np.float64)[mask], np.asarray(gradient, np.float64)[mask]
    arms = np.asarray(targets.points, np.float64)[mask] - np.asarray(placement.shift, np.float64)
    rows = np.concatenate([np.cross(gradient, arms), -gradient], axis=1)
    error = max(_MIN_ERROR, _ERROR_PER_MEDIAN * float(np.median(np.abs(distance)))) if len(distance) else 1.0
    prior_precision = np.repeat([_ROTATION_DEVIATION**-2, _SHIFT_DEVIATION**-2], 3)
    return np.linalg.inv(rows.T @ rows / error**2 + np.diag(prior_precision))


def _matrix(linear: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def _make_rigid(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Replace the linear part of a matrix, which has rounding errors, by the nearest rotation."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    return _matrix(left @ right, matrix[:3, 3])
