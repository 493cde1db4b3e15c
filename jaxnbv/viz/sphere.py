"""The sphere of candidates as a map: Mollweide's equal-area projection, front (the scene's +z) at its centre, y up."""

import math
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

WIDTH, HEIGHT = 2.0 * np.sqrt(2.0), np.sqrt(2.0)  # Half axes of the map's ellipse.
_ROWS = 160


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Vectors at length 1; zero ones stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def mollweide(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Places on the map of unit vectors: longitude atan2(x, z) to the right, latitude asin(y) upwards."""
    longitude = np.arctan2(directions[:, 0], directions[:, 2])
    sine = np.clip(directions[:, 1], -1.0, 1.0)
    # 2 t + sin 2 t = pi sin(latitude), from a table: Newton's steps stall at the poles, where the slope is zero.
    table = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 10_001)
    t = np.interp(sine, (2.0 * table + np.sin(2.0 * table)) / np.pi, table)
    return np.stack([WIDTH * longitude / np.pi * np.cos(t), HEIGHT * np.sin(t)], axis=1)


def from_mollweide(places: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Unit vectors of places on the map, and whether a place is on the map at all."""
    x, y = places.T
    t = np.arcsin(np.clip(y / HEIGHT, -1.0, 1.0))
    longitude = np.pi * x / (WIDTH * np.maximum(np.cos(t), 1e-9))
    sine = np.clip((2.0 * t + np.sin(2.0 * t)) / np.pi, -1.0, 1.0)
    return _directions(longitude, np.arcsin(sine)), (x / WIDTH) ** 2 + (y / HEIGHT) ** 2 <= 1.0


def smooth_map(directions: Float[np.ndarray, "c 3"], values: Float[np.ndarray, " c"]) -> Float[np.ndarray, "160 320"]:
    """The values of candidates carried over the map, from its top; NaN outside it, and farther from all candidates than
    nine tenths of them are from the next.

    A spline over the chords of the sphere, which goes through the values (NaN ones are left out) and stays within
    their range.
    """
    x = WIDTH * ((np.arange(2 * _ROWS) + 0.5) / _ROWS - 1.0)
    y = HEIGHT * (1.0 - 2.0 * (np.arange(_ROWS) + 0.5) / _ROWS)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    at, inside = from_mollweide(places)
    known = ~np.isnan(values)
    spline = RBFInterpolator(directions[known], values[known], kernel="thin_plate_spline")
    smooth = np.clip(spline(at), values[known].min(), values[known].max())
    tree = cKDTree(directions)
    near = tree.query(at)[0] <= np.quantile(tree.query(directions, k=2)[0][:, 1], 0.9)
    return np.where(inside & near, smooth, np.nan).reshape(_ROWS, 2 * _ROWS)


def path(directions: Float[np.ndarray, "n 3"]) -> list[Float[np.ndarray, "_ 2"]]:
    """Lines on the map that join directions by great circles: cut in two where a circle leaves the map at its rim."""
    pieces = [[directions[0]]]
    for a, b in pairwise(directions):
        # Where the chord meets the plane of the meridians 0 and 180, which is where the rim is.
        crossing = unit(np.sign(a[0]) * (a[0] * b - b[0] * a))
        if a[0] * b[0] < 0 and crossing[2] < 0:
            leaving, entering = (crossing + 1e-6 * np.sign(end[0]) * np.eye(3)[0] for end in (a, b))
            pieces[-1] += _arc(a, leaving)
            pieces.append([entering, *_arc(entering, b)])
        else:
            pieces[-1] += _arc(a, b)
    return [mollweide(unit(np.stack(piece))) for piece in pieces]


def _arc(a: np.ndarray, b: np.ndarray) -> list[np.ndarray]:
    """Directions from `a`, which is left out, to `b`: fine enough to be joined by straight lines on the map."""
    a, b = unit(a), unit(b)
    count = max(1, math.ceil(float(np.linalg.norm(b - a)) / 0.05))
    return [unit(a + t * (b - a)) for t in np.arange(1, count + 1) / count]


def graticule() -> list[Float[np.ndarray, "n 2"]]:
    """Lines on the map: parallels every 30 degrees, meridians every 60."""
    lines = []
    fine = np.linspace(-1.0, 1.0, 121)
    for latitude in np.radians([-60.0, -30.0, 0.0, 30.0, 60.0]):
        lines.append((np.pi * 0.9999 * fine, np.full_like(fine, latitude)))
    for longitude in np.radians([-120.0, -60.0, 0.0, 60.0, 120.0]):
        lines.append((np.full_like(fine, longitude), 0.5 * np.pi * fine))
    return [mollweide(_directions(longitude, latitude)) for longitude, latitude in lines]


def _directions(longitude: np.ndarray, latitude: np.ndarray) -> np.ndarray:
    ring = np.cos(latitude)
    return np.stack([ring * np.sin(longitude), np.sin(latitude), ring * np.cos(longitude)], axis=1)
