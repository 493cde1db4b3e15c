"""Skateboards."""

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, bar, box, rod

WHEEL, DECK, TRUCK = CATEGORIES[category_index("skateboard")].labels


def skateboard(rng: np.random.Generator) -> list[Primitive]:
    """A deck with raised or flat ends, on two trucks with two wheels each."""
    half_width, flat = rng.uniform(0.3, 0.4), rng.uniform(0.7, 0.9)
    rise, end, thick = rng.choice([0.0, rng.uniform(0.1, 0.3)]), rng.uniform(0.3, 0.4), rng.uniform(0.035, 0.05)
    parts = [box(DECK, (0, 0, 0), (flat, thick, half_width), 0.03)]
    base, track = 0.75 * flat, 0.8 * half_width
    radius, width, drop = rng.uniform(0.1, 0.15), rng.uniform(0.06, 0.09), rng.uniform(0.18, 0.24)
    for side in (-1, 1):
        parts.append(
            bar(DECK, (side * (flat - 0.03), 0, 0), (side * (flat + end), rise, 0), 0.9 * half_width, thick, 0.03)
        )
        x = side * base
        parts.append(box(TRUCK, (x, -0.5 * drop, 0), (0.13, 0.5 * drop, 0.12)))
        parts.append(rod(TRUCK, (x, -drop, -track), (x, -drop, track), 0.05))
        for end_side in (-1, 1):
            z = end_side * track
            parts.append(rod(WHEEL, (x, -drop, z - width), (x, -drop, z + width), radius, rounding=0.03))
    return parts
