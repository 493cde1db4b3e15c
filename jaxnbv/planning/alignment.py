"""Estimation of camera pose errors from the differences between overlapping views.

The robot reports the pose T_i for view i, but the true pose of the camera is T_i X_i. An error of the camera's mount on
the robot gives all views the same X_i = X. If single poses are wrong, each view has its own X_i, and X_0 = I. The
estimated X_i minimise the disagreement of overlapping views,

    the sum of rho(n_q . (T_i X_i p - T_j X_j q)) over points p of view i and their nearest points q of view j,

with the robust loss rho(r) = c^2 log(1 + r^2 / c^2), whose width c is twice the median disagreement. The points p and q
are in the coordinates of cameras i and j, and the normal n_q at q is in world coordinates. The method is point-to-plane
iterative closest points (Chen and Medioni 1992): each round finds the nearest points again, within a smaller distance.
A Gaussian prior keeps components of X_i that no view determines close to zero. Let J be the derivative of all distances
n_q . (T_i X_i p - T_j X_j q) with respect to X. The views determine all of X if the smallest eigenvalue of J^T J is
large enough.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxnbv.checks import checked, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose

# At most this many points of each view are compared, with those of at most this many other views.
_MAX_POINTS, _MAX_OTHER_VIEWS = 800, 4
# Views are compared if their directions differ by at most this angle. They overlap if this many points match.
_MAX_ANGLE, _MIN_MATCHES = np.radians(70.0), 20
# Rounding error of points, as a fraction of the points' median distance from the cameras.
_ROUNDING = 1e-6
# Smallest cosine of the angle between the normals of two matched points.
_MIN_COSINE = 0.7
# Largest distance between matched points in each round, as a fraction of the distance from the cameras.
_MATCH_DISTANCES = (0.08, 0.08, 0.08, 0.04, 0.04, 0.04, 0.02, 0.02, 0.01, 0.01)
# Ratio of the width c of rho to the median disagreement, and number of least-squares steps in a round.
_LOSS_WIDTH, _NUM_STEPS = 2.0, 3
# Prior standard deviation of a pose error: its rotation in radians, and its shift as a fraction of the points' distance
# from the cameras. Errors of neighbouring points are correlated, so this many points count as one independent point.
_PRIOR_DEVIATION, _POINTS_PER_SAMPLE = 0.03, 50
# The views determine all of X if the smallest eigenvalue of J^T J exceeds this fraction of the largest. The ratio is
# 4e-6 for three views of a shelf from one side, and 1e-3 or more for views that determine X.
_MIN_EIGENVALUE_RATIO = 3e-4
# A correction is rejected if it moves points by more than this fraction of their distance from the cameras.
_MAX_CORRECTION = 0.15
# The disagreement matters if it exceeds the noise times the first number. A correction is used if it divides the
# disagreement by more than the second number.
_DISAGREEMENT_RATIO, _MIN_IMPROVEMENT = 3.0, 1.5
_Corrections: TypeAlias = Float[np.ndarray, "views 4 4"]


class Alignment(eqx.Module):
    """Disagreement of overlapping views, and the pose errors that explain it.

    Lengths are in the units of the poses.

    - `disagreement`: for each view, the median point-to-plane distance between its points and the nearest points of
      overlapping views, with uncorrected poses. NaN for a view that overlaps no other view.
    - `angle`: for each view, the median angle between the normals of the same pairs of points, in radians.
    - `noise`: median point-to-plane distance between neighbouring points of the same view.
    - `corrected`: the disagreement with corrected poses.
    - `corrections`: the correction X of each view. The true pose of the camera is `matrix @ X`, where `matrix` is the
      reported pose. All X are identities if corrected poses do not agree much better.
    - `is_mount`: whether all views have the same X, which is then an error of the mount.
    - `covariance`: covariance of the mount's error, a rotation vector (radians) and a shift, in the camera's axes.
    - `is_determined`: whether the views determine all of the mount's error. Undetermined components stay close to zero.
    - `weakest`: direction in which the views determine the mount's error least, in the components of `covariance`.
    - `num_pairs`: number of compared pairs of views. Each view is compared with up to four others of similar direction.
    - `distance`: median distance of points from the camera that measured them.
    """

    disagreement: Float[np.ndarray, " views"]
    angle: Float[np.ndarray, " views"]
    noise: float
    corrected: Float[np.ndarray, " views"]
    corrections: Float[np.ndarray, "views 4 4"]
    is_mount: bool
    covariance: Float[np.ndarray, "6 6"]
    is_determined: bool
    weakest: Float[np.ndarray, "6"]
    num_pairs: int
    distance: float

    @property
    def disagrees(self) -> bool:
        """Whether the poses seem wrong.

        True if a view's disagreement exceeds three times the noise, and either poses were corrected or the views do not
        determine all of the mount's error.
        """
        return _exceeds(self.disagreement, self.noise) and (self.is_corrected or not self.is_determined)

    @property
    def is_corrected(self) -> bool:
        """Whether any pose is corrected."""
        return bool(np.any(self.corrections != np.eye(4)))

    @property
    def motion(self) -> str:
        """Description of a further view that would determine the `weakest` error of the mount better.

        A shift of the mount along an axis, or a rotation about it, looks the same in all views if the axis has the same
        world direction in all views. The advised view changes this direction.
        """
        axis = self.weakest[3:] if np.linalg.norm(self.weakest[3:]) > 0 else self.weakest[:3]
        is_ahead = abs(axis[2]) > 0.8 * np.linalg.norm(axis)
        return "a view from another side" if is_ahead else "a view with the camera turned about its optical axis"


class _View(NamedTuple):
    """Points and normals of a view in the camera's coordinates, and the camera-to-world matrix."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    matrix: Float[np.ndarray, "4 4"]

    def in_world(self, correction: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
        matrix = self.matrix @ correction
        return self.points @ matrix[:3, :3].T + matrix[:3, 3], self.normals @ matrix[:3, :3].T


class _Matches(NamedTuple):
    """Pairs of matched points from two views, in the coordinates of each point's camera.

    - `views`: for each pair, the indices of the first and the second view.
    """

    views: Int[np.ndarray, "n 2"]
    first_points: Float[np.ndarray, "n 3"]
    second_points: Float[np.ndarray, "n 3"]
    second_normals: Float[np.ndarray, "n 3"]
    first_normals: Float[np.ndarray, "n 3"]


@checked
def align_views(clouds: Sequence[PointCloud], poses: Sequence[Pose]) -> Alignment:
    """Compare overlapping views, and estimate the error of the camera's mount, or of single poses.

    If no two views overlap, `disagreement` is NaN and `is_determined` is False.

    - `clouds`: points and normals of each view, in the frame of the poses. Include points around the object, since more
      overlap gives better estimates.
    - `poses`: reported pose of each view.

    **Raises:** `ValueError` for fewer than two views, different numbers of clouds and poses, or no point in any cloud.
    """
    require(len(clouds) == len(poses), f"there are {len(clouds)} clouds and {len(poses)} poses: give a pose for each")
    require(len(clouds) >= 2, f"there are {len(clouds)} views: only two or more can disagree")
    views = [_in_camera(cloud, pose) for cloud, pose in zip(clouds, poses, strict=True)]
    pairs = _pairs(views)
    median_distance = _median(np.concatenate([np.linalg.norm(view.points, axis=1) for view in views]))
    require(median_distance > 0, f"none of the {len(clouds)} clouds has a point: there is nothing to compare")
    identities = np.tile(np.eye(4), (len(views), 1, 1))
    noise = max(_noise(views), _ROUNDING * median_distance)

    disagreement, angle = _disagreement(views, pairs, identities, median_distance)
    mount = _solve_corrections(views, pairs, identities, median_distance, is_mount=True)
    # Scale shifts by the distance, so that a rotation and a shift of the same size move points by the same length.
    unit = np.repeat([1.0, median_distance], 3)
    matches = _match_points(views, pairs, mount, _MATCH_DISTANCES[-1] * median_distance)
    _, jacobian = _linearise(views, matches, mount, is_mount=True)
    values, vectors = np.linalg.eigh((jacobian.T @ jacobian).toarray() * np.outer(unit, unit))
    is_determined = bool(values[0] > _MIN_EIGENVALUE_RATIO * values[-1])
    corrections, is_mount, corrected = identities, True, disagreement
    candidate, _ = _disagreement(views, pairs, mount, median_distance)
    exceeds_noise = _exceeds(disagreement, noise)
    is_improved = _MIN_IMPROVEMENT * _median(candidate) < _median(disagreement)
    if exceeds_noise and is_improved and _is_plausible(mount, median_distance):
        corrections, corrected = mount, candidate
    if exceeds_noise and len(views) > 2 and _exceeds(corrected, noise):
        separate = _solve_corrections(views, pairs, identities, median_distance, is_mount=False)
        candidate, _ = _disagreement(views, pairs, separate, median_distance)
        if _is_plausible(separate, median_distance) and _MIN_IMPROVEMENT * np.nanmax(candidate) < np.nanmax(corrected):
            corrections, is_mount, corrected = separate, False, candidate
    # Undetermined components keep the prior variance.
    variance = _POINTS_PER_SAMPLE * (1.4826 * np.nan_to_num(_median(corrected))) ** 2
    covariance = (vectors / (values / max(variance, 1e-30) + _PRIOR_DEVIATION**-2)) @ vectors.T
    return Alignment(
        disagreement,
        angle,
        noise,
        corrected,
        corrections,
        is_mount,
        covariance * np.outer(unit, unit),
        is_determined,
        unit * vectors[:, 0],
        len(pairs),
        median_distance,
    )


def _exceeds(disagreement: Float[np.ndarray, " views"], noise: float) -> bool:
    return bool(np.any(disagreement > _DISAGREEMENT_RATIO * noise))


def _in_camera(cloud: PointCloud, pose: Pose) -> _View:
    """Return a view with a random subset of a cloud's points, in the coordinates of the camera."""
    points, normals = (rows.astype(np.float64) for rows in cloud.to_numpy())
    rows = np.random.default_rng(0).permutation(len(points))[:_MAX_POINTS]
    matrix = np.asarray(pose.to_matrix(), np.float64)
    return _View((points[rows] - matrix[:3, 3]) @ matrix[:3, :3], normals[rows] @ matrix[:3, :3], matrix)


def _pairs(views: Sequence[_View]) -> list[tuple[int, int]]:
    """Return index pairs of views that may show the same surface: up to four with similar direction each."""
    forward = np.stack([view.matrix[:3, 2] for view in views])
    angles = np.arccos(np.clip(forward @ forward.T, -1.0, 1.0))
    np.fill_diagonal(angles, np.inf)
    nearest = np.argsort(angles, axis=1, kind="stable")[:, :_MAX_OTHER_VIEWS]
    return [(view, int(other)) for view, row in enumerate(nearest) for other in row if angles[view, other] < _MAX_ANGLE]


def _match_points(
    views: Sequence[_View], pairs: Sequence[tuple[int, int]], corrections: _Corrections, max_distance: float
) -> _Matches:
    """Match each point of a pair's first view with the nearest point of the second view.

    Matched points are at most `max_distance` apart and have similar normals. View pairs with few matches are left out.
    """
    clouds = [view.in_world(correction) for view, correction in zip(views, corrections, strict=True)]
    trees = [cKDTree(points) for points, _ in clouds]
    parts = [(np.zeros((0, 2), int), *[np.zeros((0, 3))] * 4)]
    for i, j in pairs:
        (points, normals), (_, other_normals) = clouds[i], clouds[j]
        distances, nearest = trees[j].query(points, distance_upper_bound=max_distance)
        index = np.flatnonzero(np.isfinite(distances))
        index = index[np.sum(normals[index] * other_normals[nearest[index]], axis=1) > _MIN_COSINE]
        if len(index) >= _MIN_MATCHES:
            other, first, second = nearest[index], views[i], views[j]
            pair = np.tile([i, j], (len(index), 1))
            parts.append((pair, first.points[index], second.points[other], second.normals[other], first.normals[index]))
    return _Matches(*map(np.concatenate, zip(*parts, strict=True)))


def _is_plausible(corrections: _Corrections, median_distance: float) -> bool:
    """Return whether the corrections are small enough to be pose errors."""
    angles, shifts = errors_of(corrections)
    return bool(np.max(median_distance * angles + shifts) < _MAX_CORRECTION * median_distance)


def errors_of(corrections: _Corrections) -> tuple[Float[np.ndarray, " views"], Float[np.ndarray, " views"]]:
    """Return the rotation angle in radians and the length of the shift of each correction."""
    return Rotation.from_matrix(corrections[:, :3, :3]).magnitude(), np.linalg.norm(corrections[:, :3, 3], axis=1)


def _solve_corrections(
    views: Sequence[_View],
    pairs: Sequence[tuple[int, int]],
    start: _Corrections,
    median_distance: float,
    is_mount: bool,
) -> _Corrections:
    """Return the corrections that minimise the disagreement of the views, starting from `start`.

    If `is_mount`, all views get the same correction. Otherwise each view except the first gets its own.
    """
    corrections, num_steps = start, 1 if is_mount else len(views) - 1
    deviation = _PRIOR_DEVIATION * np.tile(np.repeat([1.0, median_distance], 3), num_steps)
    for ratio in _MATCH_DISTANCES:
        matches = _match_points(views, pairs, corrections, ratio * median_distance)
        if len(matches.views) == 0:
            break
        residuals, jacobian = _linearise(views, matches, corrections, is_mount)
        scale = max(_LOSS_WIDTH * float(np.median(np.abs(residuals))), _ROUNDING * median_distance)
        errors = np.concatenate([_logarithm(matrix) for matrix in corrections[-num_steps:]])
        step = _robust_step(residuals, jacobian, scale, errors, _POINTS_PER_SAMPLE * (scale / deviation) ** 2)
        steps = np.tile(step, (len(views), 1)) if is_mount else np.concatenate([np.zeros(6), step]).reshape(-1, 6)
        corrections = corrections @ np.stack([_exponential(row) for row in steps])
    return corrections


def _robust_step(
    residuals: Float[np.ndarray, " n"],
    jacobian: csr_array,
    scale: float,
    errors: Float[np.ndarray, " steps"],
    prior: Float[np.ndarray, " steps"],
) -> Float[np.ndarray, " steps"]:
    """Return the `step` that minimises sum rho(residuals + jacobian @ step) + sum prior (errors + step)^2.

    The method is iteratively reweighted least squares.

    - `scale`: width c of the robust loss rho.
    - `errors`: the current estimates of the pose errors, each a rotation vector followed by a shift.
    - `prior`: weight of each squared error, proportional to its inverse prior variance.
    """
    step = np.zeros(jacobian.shape[1])
    for _ in range(_NUM_STEPS):
        weights = 1.0 / (1.0 + ((residuals + jacobian @ step) / scale) ** 2)
        normal = (jacobian.T @ jacobian.multiply(weights[:, None])).toarray()
        step = np.linalg.solve(normal + np.diag(prior), -(jacobian.T @ (weights * residuals)) - prior * errors)
    return step


def _linearise(
    views: Sequence[_View], matches: _Matches, corrections: _Corrections, is_mount: bool
) -> tuple[Float[np.ndarray, " n"], csr_array]:
    """Return the signed point-to-plane distance of each match, and the derivative of each distance.

    The derivative has a row for each match. Its columns are the entries of steps X <- X exp(step), where a step is a
    rotation vector and a shift: one step for the mount, or one for each view except the first. The six entries for the
    step of a view are, up to sign, (p x m, m). The point p and the normal m = n_q are in the coordinates of this view's
    camera.
    """
    poses = np.stack([view.matrix for view in views]) @ corrections
    (first, second), count = matches.views.T, len(matches.views)
    normals = np.einsum("nij,nj->ni", poses[second, :3, :3], matches.second_normals)
    differences = _transform(poses[first], matches.first_points) - _transform(poses[second], matches.second_points)
    # The plane rotates with the second view, so p for this view is the first point in the second camera's coordinates.
    opposite = matches.second_points + np.einsum("nij,ni->nj", poses[second, :3, :3], differences)
    blocks = [
        (view, sign * np.concatenate([np.cross(points, local_normals), local_normals], axis=1))
        for view, points, sign in ((first, matches.first_points, 1.0), (second, opposite, -1.0))
        for local_normals in [np.einsum("nij,ni->nj", poses[view, :3, :3], normals)]
    ]
    if is_mount:
        return np.sum(normals * differences, axis=1), csr_array(blocks[0][1] + blocks[1][1])
    row = np.repeat(np.arange(count), 6)
    entries = [(block.ravel(), row, (6 * (view[:, None] - 1) + np.arange(6)).ravel()) for view, block in blocks]
    value, row, column = map(np.concatenate, zip(*entries, strict=True))
    is_free, size = column >= 0, (count, 6 * (len(views) - 1))
    jacobian = csr_array((value[is_free], (row[is_free], column[is_free])), shape=size)
    return np.sum(normals * differences, axis=1), jacobian


def _transform(matrices: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", matrices[:, :3, :3], points) + matrices[:, :3, 3]


def _exponential(step: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """Return the 4 x 4 matrix of a rigid motion, given as a rotation vector followed by a shift."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
    return matrix


def _logarithm(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    return np.append(Rotation.from_matrix(matrix[:3, :3]).as_rotvec(), matrix[:3, 3])


def _disagreement(
    views: Sequence[_View], pairs: Sequence[tuple[int, int]], corrections: _Corrections, median_distance: float
) -> tuple[Float[np.ndarray, " views"], Float[np.ndarray, " views"]]:
    """Return each view's median point-to-plane distance and median angle between normals (radians).

    The medians are over the view's matches, at the corrected poses. They are NaN for a view without matches.
    """
    matches = _match_points(views, pairs, corrections, _MATCH_DISTANCES[0] * median_distance)
    residuals, _ = _linearise(views, matches, corrections, is_mount=True)
    rotations = np.stack([view.matrix for view in views])[:, :3, :3] @ corrections[:, :3, :3]
    first_normals, second_normals = (
        np.einsum("nij,nj->ni", rotations[view], normals)
        for view, normals in zip(matches.views.T, (matches.first_normals, matches.second_normals), strict=True)
    )
    angle = np.arccos(np.clip(np.sum(first_normals * second_normals, axis=1), -1.0, 1.0))
    median = np.full((2, len(views)), np.nan)
    for index in range(len(views)):
        is_of_view = (matches.views == index).any(axis=1)
        if is_of_view.any():
            median[:, index] = np.median(np.abs(residuals[is_of_view])), np.median(angle[is_of_view])
    return median[0], median[1]


def _median(values: Float[np.ndarray, " n"]) -> float:
    """Return the median of the finite values; NaN if there are none."""
    numbers = values[np.isfinite(values)]
    return float(np.median(numbers)) if len(numbers) else np.nan


def _noise(views: Sequence[_View]) -> float:
    """Return the median distance of points from the tangent plane at the nearest point of the same view."""
    distances = [np.zeros(0)]
    for points, normals, _ in views:
        if len(points) < 2:
            continue
        _, nearest = cKDTree(points).query(points, k=2)
        distances.append(np.sum(normals[nearest[:, 1]] * (points - points[nearest[:, 1]]), axis=1))
    return float(np.nan_to_num(_median(np.abs(np.concatenate(distances)))))
