"""Compares the points of overlapping views, and estimates pose errors that explain the differences.

The pose that the robot reports for view i is T_i, and the true pose of the camera is T_i X_i. If the mount of the
camera is off, X_i = X is the same for all views. If single poses are off, each view has its own X_i, and X_0 = I. The
X_i are estimated by minimising the disagreement of overlapping views,

    the sum over points p of view i and the nearest point q of view j  of  rho(n_q . (T_i X_i p - T_j X_j q)),

with the robust loss rho(r) = c^2 log(1 + r^2 / c^2), whose width c is twice the median disagreement. The points p and q
are in the coordinates of cameras i and j, and the normal n_q at q is in world coordinates. A Gaussian prior keeps
components that no view determines close to zero. The nearest points are searched again in each round, within a distance
that decreases (point-to-plane iterative closest points, Chen and Medioni 1992). The views determine all of X if the
smallest eigenvalue of J^T J is large enough, where J is the derivative of the arguments of rho with respect to X.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxnbv.checks import checked, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose

# Largest number of points of a view that are compared, and of other views with which a view is compared.
_POINTS, _OTHERS = 800, 4
# Largest angle between the directions of two views that are compared, and fewest matched points that count as overlap.
_WIDEST, _FEWEST = np.radians(70.0), 20
# Rounding error of points, as a fraction of the points' median distance from the cameras.
_ROUNDING = 1e-6
# Smallest cosine of the angle between the normals of two matched points.
_ALIKE = 0.7
# Largest distance between matched points in each round, as a fraction of the distance from the cameras.
_REACHES = (0.08, 0.08, 0.08, 0.04, 0.04, 0.04, 0.02, 0.02, 0.01, 0.01)
# Ratio of the width c of rho to the median disagreement, and number of least-squares steps in a round.
_SCALE, _STEPS = 2.0, 3
# Prior standard deviation of a pose error: in radians, and of its shift as a fraction of the distance from the cameras.
# The errors of neighbouring points are correlated. Therefore _TOGETHER points count as one independent point.
_ERROR, _TOGETHER = 0.03, 50
# The views determine all of X if the smallest eigenvalue of J^T J exceeds this fraction of the largest. The ratio is
# 4e-6 for three views of a shelf from one side, and 1e-3 or more for views that determine X.
_TOLD = 3e-4
# A correction is rejected if it moves points by more than this fraction of their distance from the cameras.
_MOST = 0.15
# Views that differ by more than _OFF times the noise disagree. A correction must divide their difference by _LESS.
_OFF, _LESS = 3.0, 1.5
_Corrections: TypeAlias = Float[np.ndarray, "views 4 4"]


class Alignment(eqx.Module):
    """How much overlapping views disagree, and the pose error that explains it.

    Lengths are in the units of the poses.

    - `disagreement`: median point-to-plane distance between the points of a view and the nearest points of the views
      that overlap it, with uncorrected poses. NaN for a view that overlaps no other view.
    - `angle`: median angle between the normals of these pairs of points, in radians.
    - `noise`: median point-to-plane distance between neighbouring points of the same view.
    - `corrected`: `disagreement` with corrected poses.
    - `corrections`: (views, 4, 4), the correction X of each view. The true pose of the camera is `matrix @ X`, where
      `matrix` is the reported pose. All X are identities if corrected poses do not agree much better.
    - `is_mount`: whether all views have the same X, which is then an error of the mount.
    - `covariance`: covariance of the mount's error: a rotation vector (radians), then a shift, in the camera's axes.
    - `is_determined`: whether the views determine all components of the mount's error. Undetermined components stay
      close to zero.
    - `weakest`: direction of the mount's error that the views determine least: a rotation vector, then a shift.
    - `num_pairs`: number of pairs of views that were compared. Each view is compared with up to four other views of
      similar direction.
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

        True if the disagreement of a view exceeds three times the noise, and either poses were corrected or the views
        do not determine all of the mount's error.
        """
        is_off = bool(np.any(self.disagreement > _OFF * self.noise))
        return is_off and (self.is_corrected or not self.is_determined)

    @property
    def is_corrected(self) -> bool:
        """Whether any pose is corrected."""
        return bool(np.any(self.corrections != np.eye(4)))

    @property
    def errors(self) -> tuple[Float[np.ndarray, " views"], Float[np.ndarray, " views"]]:
        """Rotation angle (radians) and length of the shift of each view's correction."""
        return errors_of(self.corrections)

    @property
    def motion(self) -> str:
        """Text that names the further view that would best determine the `weakest` error of the mount.

        A shift along an axis, or a rotation about it, looks the same in all views if all motions between the views keep
        the direction of the axis. The named view changes this direction.
        """
        axis = self.weakest[3:] if np.linalg.norm(self.weakest[3:]) > 0 else self.weakest[:3]
        is_ahead = abs(axis[2]) > 0.8 * np.linalg.norm(axis)
        return "a view from another side" if is_ahead else "a view with the camera turned about its optical axis"


class _View(NamedTuple):
    """Points and normals of a view in the camera's coordinates, and the camera-to-world matrix."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    matrix: Float[np.ndarray, "4 4"]

    def placed(self, correction: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
        true = self.matrix @ correction
        return self.points @ true[:3, :3].T + true[:3, 3], self.normals @ true[:3, :3].T


class _Matches(NamedTuple):
    """Matched points of pairs of views, each in the coordinates of its own camera.

    - `views`: for each match, the indices of the two views.
    - `first`, `own_normals`: point and normal in the first view.
    - `second`, `normals`: point and normal in the second view.
    """

    views: Int[np.ndarray, "n 2"]
    first: Float[np.ndarray, "n 3"]
    second: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    own_normals: Float[np.ndarray, "n 3"]


@checked
def align_views(clouds: Sequence[PointCloud], poses: Sequence[Pose]) -> Alignment:
    """Compare overlapping views, and estimate the error of the camera's mount, or of single poses.

    If no two views overlap, `disagreement` is NaN and `is_determined` is False.

    - `clouds`: points and normals of each view, in the same frame as the poses. Include points around the object, since
      more overlap gives better estimates.
    - `poses`: pose of each view, possibly with an error.

    **Raises:** `ValueError` for fewer than two views, different numbers of clouds and poses, or clouds without points.
    """
    require(len(clouds) == len(poses), f"there are {len(clouds)} clouds and {len(poses)} poses: give a pose for each")
    require(len(clouds) >= 2, f"there are {len(clouds)} views: only two or more can disagree")
    views = [_in_camera(cloud, pose) for cloud, pose in zip(clouds, poses, strict=True)]
    pairs, away = _pairs(views), _median(np.concatenate([np.linalg.norm(view.points, axis=1) for view in views]))
    require(away > 0, f"none of the {len(clouds)} clouds has a point: there is nothing to compare")
    still = np.tile(np.eye(4), (len(views), 1, 1))
    noise = max(_noise(views), _ROUNDING * away)

    off, angle = _compared(views, pairs, still, away)
    mount = _solved(views, pairs, still, away, is_mount=True)
    # Scale shifts by the distance, so that a rotation and a shift of the same size move points by the same length.
    unit = np.repeat([1.0, away], 3)
    matches = _matched(views, pairs, mount, _REACHES[-1] * away)
    _, rows = _linearised(views, matches, mount, is_mount=True)
    values, vectors = np.linalg.eigh((rows.T @ rows).toarray() * np.outer(unit, unit))
    is_determined = bool(values[0] > _TOLD * values[-1])
    corrections, is_mount, left = still, True, off
    after, _ = _compared(views, pairs, mount, away)
    is_off = bool(np.any(off > _OFF * noise))
    if is_off and _is_plausible(mount, away) and _LESS * _median(after) < _median(off):
        corrections, left = mount, after
    if is_off and len(views) > 2 and np.any(left > _OFF * noise):
        each = _solved(views, pairs, still, away, is_mount=False)
        after, _ = _compared(views, pairs, each, away)
        if _is_plausible(each, away) and _LESS * np.nanmax(after) < np.nanmax(left):
            corrections, is_mount, left = each, False, after
    # Undetermined components keep the prior variance.
    error = _TOGETHER * (1.4826 * np.nan_to_num(_median(left))) ** 2
    covariance = (vectors / (values / max(error, 1e-30) + _ERROR**-2)) @ vectors.T
    return Alignment(
        off,
        angle,
        noise,
        left,
        corrections,
        is_mount,
        covariance * np.outer(unit, unit),
        is_determined,
        unit * vectors[:, 0],
        len(pairs),
        away,
    )


def _in_camera(cloud: PointCloud, pose: Pose) -> _View:
    """Return a view with a random subset of a cloud's points, in the coordinates of the camera."""
    points, normals = (rows.astype(np.float64) for rows in cloud.to_numpy())
    rows = np.random.default_rng(0).permutation(len(points))[:_POINTS]
    matrix = np.asarray(pose.to_matrix(), np.float64)
    return _View((points[rows] - matrix[:3, 3]) @ matrix[:3, :3], normals[rows] @ matrix[:3, :3], matrix)


def _pairs(views: Sequence[_View]) -> list[tuple[int, int]]:
    """Return pairs of views that may show the same surface: each view with a few of similar direction."""
    ahead = np.stack([view.matrix[:3, 2] for view in views])
    angles = np.arccos(np.clip(ahead @ ahead.T, -1.0, 1.0))
    np.fill_diagonal(angles, np.inf)
    nearest = np.argsort(angles, axis=1, kind="stable")[:, :_OTHERS]
    return [(view, int(other)) for view, row in enumerate(nearest) for other in row if angles[view, other] < _WIDEST]


def _matched(
    views: Sequence[_View], pairs: Sequence[tuple[int, int]], corrections: _Corrections, reach: float
) -> _Matches:
    """Match each point of a pair's first view with the nearest point of the second view.

    Matches are at most `reach` apart and have similar normals. Pairs of views with few matches are left out.
    """
    placed = [view.placed(correction) for view, correction in zip(views, corrections, strict=True)]
    trees = [cKDTree(points) for points, _ in placed]
    rows = [(np.zeros((0, 2), int), *[np.zeros((0, 3))] * 4)]
    for i, j in pairs:
        (points, normals), (_, others) = placed[i], placed[j]
        distance, nearest = trees[j].query(points, distance_upper_bound=reach)
        own = np.flatnonzero(np.isfinite(distance))
        own = own[np.sum(normals[own] * others[nearest[own]], axis=1) > _ALIKE]
        if len(own) >= _FEWEST:
            other, one, two = nearest[own], views[i], views[j]
            both = np.tile([i, j], (len(own), 1))
            rows.append((both, one.points[own], two.points[other], two.normals[other], one.normals[own]))
    return _Matches(*map(np.concatenate, zip(*rows, strict=True)))


def _is_plausible(corrections: _Corrections, away: float) -> bool:
    """Return whether the corrections are small enough to be errors of poses.

    They must move points by less than 15 % of `away`, the median distance of points from the cameras.
    """
    turn, shift = errors_of(corrections)
    return bool(np.max(away * turn + shift) < _MOST * away)


def errors_of(corrections: _Corrections) -> tuple[Float[np.ndarray, " views"], Float[np.ndarray, " views"]]:
    """Return the rotation angle in radians and the length of the shift of each correction."""
    return Rotation.from_matrix(corrections[:, :3, :3]).magnitude(), np.linalg.norm(corrections[:, :3, 3], axis=1)


def _solved(
    views: Sequence[_View], pairs: Sequence[tuple[int, int]], start: _Corrections, away: float, is_mount: bool
) -> _Corrections:
    """Return the corrections that minimise the disagreement of the views, starting from `start`.

    If `is_mount`, all views get the same correction. Otherwise each view but the first gets its own. `away` is the
    median distance of points from the cameras.
    """
    corrections, num_steps = start, 1 if is_mount else len(views) - 1
    for reach in _REACHES:
        matches = _matched(views, pairs, corrections, reach * away)
        if len(matches.views) == 0:
            break
        off, rows = _linearised(views, matches, corrections, is_mount)
        scale = max(_SCALE * float(np.median(np.abs(off))), _ROUNDING * away)
        errors = np.concatenate([_logarithm(matrix) for matrix in corrections[-num_steps:]])
        prior = _TOGETHER * (scale / (_ERROR * np.tile(np.repeat([1.0, away], 3), num_steps))) ** 2
        step = _robust(off, rows, scale, errors, prior)
        steps = np.tile(step, (len(views), 1)) if is_mount else np.concatenate([np.zeros(6), step]).reshape(-1, 6)
        corrections = corrections @ np.stack([_exponential(row) for row in steps])
    return corrections


def _robust(
    off: Float[np.ndarray, " n"],
    rows: csr_array,
    scale: float,
    errors: Float[np.ndarray, " steps"],
    prior: Float[np.ndarray, " steps"],
) -> Float[np.ndarray, " steps"]:
    """Return the `step` that minimises sum rho(off + rows @ step) + sum prior (errors + step)^2.

    The method is iteratively reweighted least squares. rho is the robust loss of the module's docstring.

    - `off`, `rows`: point-to-plane distances and their derivative, from `_linearised`.
    - `scale`: width c of rho.
    - `errors`, `prior`: the corrections so far, and the weights that pull them towards zero.
    """
    step = np.zeros(rows.shape[1])
    for _ in range(_STEPS):
        weight = 1.0 / (1.0 + ((off + rows @ step) / scale) ** 2)
        normal = (rows.T @ rows.multiply(weight[:, None])).toarray()
        step = np.linalg.solve(normal + np.diag(prior), -(rows.T @ (weight * off)) - prior * errors)
    return step


def _linearised(
    views: Sequence[_View], matches: _Matches, corrections: _Corrections, is_mount: bool
) -> tuple[Float[np.ndarray, " n"], csr_array]:
    """Return the signed point-to-plane distance of each match, and its derivative.

    The distance is n_q . (T_i X_i p - T_j X_j q), see the module's docstring. The derivative is with respect to steps
    X <- X exp(step): one step for the mount, or one for each view but the first. Its six entries for a view are, up to
    sign, (p x m, m) with the point p and the normal m = n_q in the coordinates of this view's camera.
    """
    true = np.stack([view.matrix for view in views]) @ corrections
    (first, second), count = matches.views.T, len(matches.views)
    normals = np.einsum("nij,nj->ni", true[second, :3, :3], matches.normals)
    apart = _placed(true[first], matches.first) - _placed(true[second], matches.second)
    # The plane rotates with the second view, so p for this view is the first point in the second camera's coordinates.
    opposite = matches.second + np.einsum("nij,ni->nj", true[second, :3, :3], apart)
    shares = [
        (view, sign * np.concatenate([np.cross(points, turned), turned], axis=1))
        for view, points, sign in ((first, matches.first, 1.0), (second, opposite, -1.0))
        for turned in [np.einsum("nij,ni->nj", true[view, :3, :3], normals)]
    ]
    if is_mount:
        return np.sum(normals * apart, axis=1), csr_array(shares[0][1] + shares[1][1])
    row = np.repeat(np.arange(count), 6)
    entries = [(share.ravel(), row, (6 * (view[:, None] - 1) + np.arange(6)).ravel()) for view, share in shares]
    value, row, column = map(np.concatenate, zip(*entries, strict=True))
    own, size = column >= 0, (count, 6 * (len(views) - 1))
    return np.sum(normals * apart, axis=1), csr_array(coo_array((value[own], (row[own], column[own])), shape=size))


def _placed(matrices: Float[np.ndarray, "n 4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", matrices[:, :3, :3], points) + matrices[:, :3, 3]


def _exponential(step: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """Return the 4 x 4 matrix of a rigid motion, given as a rotation vector followed by a shift."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
    return matrix


def _logarithm(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    return np.append(Rotation.from_matrix(matrix[:3, :3]).as_rotvec(), matrix[:3, 3])


def _compared(
    views: Sequence[_View], pairs: Sequence[tuple[int, int]], corrections: _Corrections, away: float
) -> tuple[Float[np.ndarray, " views"], Float[np.ndarray, " views"]]:
    """Return, for each view, how much it disagrees with the views that `pairs` compares it with.

    Points of two views are matched. The results are two medians over a view's matches: of the point-to-plane distance
    between the two points, and of the angle between their normals (radians). NaN for a view without matches. `away` is
    the median distance of points from the cameras.
    """
    matches = _matched(views, pairs, corrections, _REACHES[0] * away)
    off, _ = _linearised(views, matches, corrections, is_mount=True)
    turns = np.stack([view.matrix for view in views])[:, :3, :3] @ corrections[:, :3, :3]
    first, second = (
        np.einsum("nij,nj->ni", turns[view], normals)
        for view, normals in zip(matches.views.T, (matches.own_normals, matches.normals), strict=True)
    )
    angle = np.arccos(np.clip(np.sum(first * second, axis=1), -1.0, 1.0))
    median = np.full((2, len(views)), np.nan)
    for number in range(len(views)):
        own = (matches.views == number).any(axis=1)
        if own.any():
            median[:, number] = np.median(np.abs(off[own])), np.median(angle[own])
    return median[0], median[1]


def _median(values: Float[np.ndarray, " n"]) -> float:
    """Return the median of the finite values; NaN if there are none."""
    numbers = values[np.isfinite(values)]
    return float(np.median(numbers)) if len(numbers) else np.nan


def _noise(views: Sequence[_View]) -> float:
    """Return the median distance of points from the tangent plane at the nearest point of the same view."""
    off = [np.zeros(0)]
    for points, normals, _ in views:
        if len(points) < 2:
            continue
        _, nearest = cKDTree(points).query(points, k=2)
        off.append(np.sum(normals[nearest[:, 1]] * (points - points[nearest[:, 1]]), axis=1))
    return float(np.nan_to_num(_median(np.abs(np.concatenate(off)))))
