"""Views beyond the boundary of what has been seen: the candidates of Boundary Exploration NBV (leihui6/BENBV)."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

# Of the paper's code: neighbours of a point, the angle without any of them that makes it a boundary point, clusters of
# boundary points, and by which angles the view is turned about the boundary, one after the other.
NEIGHBOURS, GAP, VIEWS, TURNS = 30, np.radians(120.0), 20, np.radians([-45.0, 0.0, 45.0])


def boundary_views(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], seed: int
) -> tuple[Float[np.ndarray, "views 3"], Float[np.ndarray, "views 3"]]:
    """Points of the boundary to look at, one a cluster, and the unit directions to look from; none where no point is
    of the boundary."""
    tree = cKDTree(points)
    apart, near = tree.query(points, k=min(NEIGHBOURS, len(points)))
    (rows,) = np.nonzero(is_boundary(points, normals, apart[:, 1:], near[:, 1:]))
    if len(rows) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    _, label = kmeans2(points[rows], min(VIEWS, len(rows)), minit="++", seed=seed)
    chosen = []
    for cluster in np.unique(label):
        of = rows[label == cluster]
        chosen.append(of[np.argmin(np.linalg.norm(points[of] - points[of].mean(axis=0), axis=1))])
    targets, up = points[chosen], normals[chosen]
    out = unit(targets - points[near[chosen, 1:]].mean(axis=1))
    axes = np.cross(out, up)
    turns = TURNS[np.arange(len(chosen)) % len(TURNS)][:, None] * np.linalg.norm(axes, axis=1, keepdims=True)
    along = unit(axes)
    # Rodrigues' rotation of the normal about the boundary.
    turned = up * np.cos(turns) + np.cross(along, up) * np.sin(turns)
    turned += along * np.sum(along * up, axis=1, keepdims=True) * (1.0 - np.cos(turns))
    return targets, unit(turned)


def is_boundary(points, normals, apart, near) -> Bool[np.ndarray, " n"]:
    """Whether the neighbours, seen along the normal, leave a gap of more than `GAP` around a point."""
    first = unit(np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)]))
    second = np.cross(normals, first)
    away = points[near] - points[:, None]
    angle = np.arctan2(np.einsum("nkd,nd->nk", away, second), np.einsum("nkd,nd->nk", away, first))
    counts = apart < apart.mean()
    angle = np.sort(np.where(counts, angle, np.inf), axis=1)
    count = np.sum(counts, axis=1)
    with np.errstate(invalid="ignore"):
        gaps = np.nan_to_num(np.diff(angle, axis=1), nan=0.0, posinf=0.0)
    last = angle[np.arange(len(points)), np.maximum(count - 1, 0)]
    around = np.where(count > 0, 2.0 * np.pi - (last - angle[:, 0]), 2.0 * np.pi)
    return np.maximum(gaps.max(axis=1, initial=0.0), around) > GAP


def unit(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
