"""Maps of the sphere in longitude and latitude (radians). The scene's +z axis is at the centre, +y at the top."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

_ROWS = 90


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Scale vectors to length 1. Zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def on_map(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Return the longitudes atan2(x, z) and latitudes asin(y) of unit vectors."""
    x, y, z = directions.T
    return np.stack([np.arctan2(x, z), np.arcsin(np.clip(y, -1.0, 1.0))], axis=1)


def smooth_map(
    directions: Float[np.ndarray, "c 3"], values: Float[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " n"], Float[np.ndarray, "n m"]]:
    """Interpolate the candidates' values over the map. Return longitudes, latitudes, and values there.

    The interpolant is a spline through the values that are not NaN, and stays within their range. It is NaN where no
    candidate is near: the limit is the 90th percentile of the distances between neighbouring candidates.
    """
    longitudes = np.pi * ((np.arange(2 * _ROWS) + 0.5) / _ROWS - 1.0)
    latitudes = np.pi * ((np.arange(_ROWS) + 0.5) / _ROWS - 0.5)
    longitude, latitude = np.meshgrid(longitudes, latitudes)
    ring = np.cos(latitude)
    at = np.stack([ring * np.sin(longitude), np.sin(latitude), ring * np.cos(longitude)], axis=-1).reshape(-1, 3)
    has_value = ~np.isnan(values)
    spline = RBFInterpolator(directions[has_value], values[has_value], kernel="thin_plate_spline")
    smooth = np.clip(spline(at), values[has_value].min(), values[has_value].max())
    tree = cKDTree(directions)
    near = tree.query(at)[0] <= np.quantile(tree.query(directions, k=2)[0][:, 1], 0.9)
    return longitudes, latitudes, np.where(near, smooth, np.nan).reshape(longitude.shape)


def path(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 2"]:
    """Return a line on the map that joins directions by great circles. NaN rows split it at the map's rim."""
    steps = np.linspace(0.0, 1.0, 20)[:, None]
    fine = on_map(unit(np.concatenate([a + steps * (b - a) for a, b in pairwise(directions)])))
    leaps = np.flatnonzero(np.abs(np.diff(fine[:, 0])) > np.pi) + 1
    return np.insert(fine, leaps, np.nan, axis=0)
