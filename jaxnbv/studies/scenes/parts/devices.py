"""Headphones, laptops and pistols."""

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, bar, box, path, ring, rod, shifted

CUP, BAND, WIRE = CATEGORIES[category_index("earphone")].labels
KEYBOARD, SCREEN = CATEGORIES[category_index("laptop")].labels
BARREL, GRIP, TRIGGER = CATEGORIES[category_index("pistol")].labels


def earphone(rng: np.random.Generator) -> list[Primitive]:
    """Two cups under an arched band; a wire that hangs from one of them, or none."""
    half_width, rise = rng.uniform(0.75, 0.95), rng.uniform(0.95, 1.2)
    radius, thick, width = rng.uniform(0.32, 0.42), rng.uniform(0.1, 0.16), rng.uniform(0.06, 0.09)
    angle = np.linspace(0, np.pi, 9)
    points = np.stack([np.zeros(9), rise * np.sin(angle), half_width * np.cos(angle)], axis=-1)
    parts = path(BAND, points, width)
    for side in (-1, 1):
        z = side * half_width
        parts.append(rod(CUP, (0, -0.1, z - thick), (0, -0.1, z + thick), radius, rounding=0.06))
        parts.append(ring(CUP, (0, -0.1, z - side * (thick + 0.04)), (0, 0, 1), radius - 0.1, 0.07, 0.07, 0.06))
    if rng.random() < 0.7:
        z, low = rng.choice([-1, 1]) * half_width, -0.1 - radius
        swing = rng.uniform(-0.2, 0.2, 2)
        end = (swing[0] + 0.1, low - rng.uniform(0.6, 0.9), z + swing[1])
        parts += path(WIRE, [(0, low + 0.05, z), (0.05, low - 0.3, z), end], 0.04)
    return parts


def laptop(rng: np.random.Generator) -> list[Primitive]:
    """Opened to between 90 and 130 degrees."""
    half_width, half_depth, thick = rng.uniform(1.1, 1.25), rng.uniform(0.7, 0.9), rng.uniform(0.04, 0.06)
    lean = rng.uniform(0.0, np.radians(40))
    hinge = np.array([-half_depth + 0.03, 0.0, 0.0])
    top = hinge + 2 * half_depth * np.array([-np.sin(lean), np.cos(lean), 0.0])
    return [
        box(KEYBOARD, (0, 0, 0), (half_depth, thick, half_width), 0.03),
        bar(SCREEN, hinge, top, half_width, 0.035, 0.03),
    ]


def pistol(rng: np.random.Generator) -> list[Primitive]:
    """A slide with a barrel, or a revolver's drum; a slanted grip, a guard around the trigger."""
    half, length, drop = rng.uniform(0.13, 0.17), rng.uniform(0.9, 1.1), rng.uniform(0.75, 0.95)
    parts = [box(BARREL, (0.1, 0, 0), (length, half, 0.75 * half), 0.04)]
    parts.append(rod(BARREL, (length - 0.1, 0.02, 0), (length + rng.uniform(0.2, 0.35), 0.02, 0), 0.08))
    parts.append(box(BARREL, (0.9 * length, half, 0), (0.06, 0.06, 0.03)))
    if rng.random() < 0.4:
        parts.append(rod(BARREL, (-0.25, 0, 0), (0.25, 0, 0), rng.uniform(1.3, 1.5) * half, rounding=0.04))
    slope, grip = rng.uniform(0.1, 0.35), rng.uniform(0.16, 0.2)
    top = np.array([-length + 0.3, 0.0, 0.0])
    parts.append(bar(GRIP, top, shifted(top, -slope, -drop), 0.8 * half, grip, 0.05))
    guard = rng.uniform(0.18, 0.22)
    centre = shifted(top, grip + guard - 0.02, -half - guard + 0.06)
    parts.append(ring(TRIGGER, centre, (0, 0, 1), guard, 0.035, 0.05))
    parts.append(bar(TRIGGER, shifted(centre, 0.02, guard), shifted(centre, 0.06, -0.3 * guard), 0.035, 0.035))
    return parts
