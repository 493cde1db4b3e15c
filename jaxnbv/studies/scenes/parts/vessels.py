"""Mugs."""

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, path, ring, rod

HANDLE, BODY = CATEGORIES[category_index("mug")].labels


def mug(rng: np.random.Generator) -> list[Primitive]:
    """A hollow body, straight or widening, and a round or square handle behind."""
    radius, half_height = rng.uniform(0.6, 0.85), rng.uniform(0.75, 1.0)
    slant, wall = rng.uniform(-0.05, 0.2), 0.05
    parts = [
        ring(BODY, (0, 0, 0), (0, 1, 0), radius - wall, wall, half_height, 0.03, slant),
        rod(BODY, (0, -half_height, 0), (0, -half_height + 0.12, 0), radius - wall - slant * half_height),
    ]
    reach = rng.uniform(0.5, 0.7)
    top, bottom = rng.uniform(0.5, 0.7) * half_height, rng.uniform(-0.7, -0.5) * half_height
    angle = np.linspace(0.5 * np.pi, -0.5 * np.pi, 6)
    # Between an ellipse and a square.
    power = rng.choice([1.0, 0.55])
    out = reach * np.cos(angle) ** power
    y = 0.5 * (top + bottom) + 0.5 * (top - bottom) * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power
    start = radius - wall + slant * y
    points = np.stack([-start - out, y, np.zeros(6)], axis=-1)
    return parts + path(HANDLE, points, rng.uniform(0.08, 0.12))
