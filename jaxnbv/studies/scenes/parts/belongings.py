"""Bags and guitars."""

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, bar, box, path, rod

HANDLE, BAG_BODY = CATEGORIES[category_index("bag")].labels
HEAD, NECK, BODY = CATEGORIES[category_index("guitar")].labels


def bag(rng: np.random.Generator) -> list[Primitive]:
    """A box or a roll with one or two handles above, a pocket in front or none."""
    half_width, handles = rng.uniform(0.8, 1.1), int(rng.integers(1, 3))
    half_height, half_depth = rng.uniform(0.5, 0.75), rng.uniform(0.22, 0.4)
    if rng.random() < 0.3:
        half_depth = half_height = rng.uniform(0.45, 0.6)
        parts = [rod(BAG_BODY, (0, 0, -half_width), (0, 0, half_width), half_height, rounding=0.12)]
    else:
        parts = [box(BAG_BODY, (0, 0, 0), (half_depth, half_height, half_width), rng.uniform(0.05, 0.2))]
    if rng.random() < 0.5:
        half = (0.1, rng.uniform(0.3, 0.5) * half_height, rng.uniform(0.4, 0.7) * half_width)
        parts.append(box(BAG_BODY, (half_depth, -0.3 * half_height, 0), half, 0.06))
    rise, span, radius = rng.uniform(0.5, 0.8), rng.uniform(0.4, 0.7) * half_width, rng.uniform(0.06, 0.09)
    angle = np.linspace(0, np.pi, 7)
    for place in [0.0] if handles == 1 else [-0.5 * half_depth, 0.5 * half_depth]:
        root = half_height - 0.02 if handles == 1 else 0.85 * half_height
        points = np.stack([np.full(7, place), root + rise * np.sin(angle) ** 0.7, span * np.cos(angle)], axis=-1)
        parts += path(HANDLE, points, radius)
    return parts


def guitar(rng: np.random.Generator) -> list[Primitive]:
    """Upright, the strings in front: a body with a waist, or a solid one with horns; pegs beside the head."""
    lower, upper = rng.uniform(0.42, 0.52), rng.uniform(0.32, 0.4)
    depth, thin = rng.uniform(0.08, 0.16), rng.uniform(0.04, 0.055)
    waist, neck = rng.uniform(0.5, 0.6), rng.uniform(0.95, 1.15)

    def disc(y, z, radius):
        return rod(BODY, (-depth, y, z), (depth, y, z), radius, rounding=0.04)

    parts = [disc(0.0, 0.0, lower), disc(waist, 0.0, upper), box(BODY, (0, 0.5 * waist, 0), (depth, 0.3, 0.7 * upper))]
    top = waist + upper
    if rng.random() < 0.4:
        parts += [bar(BODY, (0, waist, side * 0.2), (0, top + 0.1, side * 0.3), 0.07, depth, 0.05) for side in (-1, 1)]
    front = depth + thin - 0.02
    parts.append(box(BODY, (front, -0.1, 0), (thin, 0.045, 0.2)))
    parts.append(bar(NECK, (front, 0.5 * waist, 0), (front, top + neck, 0), rng.uniform(0.07, 0.09), thin + 0.01))
    tilt, length = rng.uniform(0.0, 0.1), rng.uniform(0.3, 0.4)
    crown = (front - tilt, top + neck + length, 0)
    parts.append(bar(HEAD, (front, top + neck, 0), crown, rng.uniform(0.11, 0.15), 0.05))
    for place in (0.25, 0.55, 0.85):
        x, y = front - place * tilt, top + neck + place * length
        parts.append(rod(HEAD, (x, y, -0.22), (x, y, 0.22), 0.035))
    return parts
