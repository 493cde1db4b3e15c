"""Airplanes and rockets."""

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, bar, box, rod, rotation_about

BODY, WING, TAIL, ENGINE = CATEGORIES[category_index("airplane")].labels
HULL, FIN, NOSE = CATEGORIES[category_index("rocket")].labels


def airplane(rng: np.random.Generator) -> list[Primitive]:
    """Swept wings, low or high, with two or four engines below them, or two beside the tail; a low or a high tail."""
    radius, sweep = rng.uniform(0.12, 0.17), rng.uniform(0.1, 0.6)
    parts = [
        rod(BODY, (-0.55, 0, 0), (0.85, 0, 0), radius, rounding=0.0),
        rod(BODY, (0.83, 0, 0), (1.22, -0.02, 0), radius, 0.35 * radius, rounding=0.03),
        rod(BODY, (-1.25, 0.06, 0), (-0.53, 0, 0), 0.4 * radius, radius),
    ]
    span, chord, height = rng.uniform(0.95, 1.25), rng.uniform(0.17, 0.24), rng.choice([-0.5, 0.6]) * radius
    dihedral = rng.uniform(0.0, 0.12)
    kind = rng.choice(["two", "four", "tail"], p=[0.45, 0.3, 0.25])
    size = rng.uniform(0.08, 0.1)
    for side in (-1, 1):
        root, tip = np.array([0.15, height, 0.0]), np.array([0.15 - sweep, height + dihedral, side * span])
        parts.append(bar(WING, root, 0.45 * tip + 0.55 * root, 1.2 * chord, 0.04))
        parts.append(bar(WING, 0.35 * tip + 0.65 * root, tip, 0.8 * chord, 0.033))
        for place in {"two": (0.35,), "four": (0.3, 0.6), "tail": ()}[kind]:
            x, y, z = (1 - place) * root + place * tip
            y -= size + 0.05
            parts.append(rod(ENGINE, (x - 0.1, y, z), (x + 0.3, y, z), 0.85 * size, size))
            parts.append(box(ENGINE, (x + 0.05, y + size, z), (0.12, 0.06, 0.03)))
        if kind == "tail":
            z = side * (radius + 0.6 * size)
            parts.append(rod(ENGINE, (-0.8, 0.05, z), (-0.35, 0.05, z), 0.85 * size, size))
    rise = rng.uniform(0.38, 0.5)
    parts.append(bar(TAIL, (-1.0, 0.05, 0), (-1.2, rise, 0), 0.035, 0.15))
    level = rise if kind == "tail" else 0.1
    back = -1.2 if kind == "tail" else -1.08
    reach = rng.uniform(0.36, 0.45)
    for side in (-1, 1):
        parts.append(bar(TAIL, (back, level, 0), (back - 0.15, level, side * reach), 0.12, 0.033))
    return parts


def rocket(rng: np.random.Generator) -> list[Primitive]:
    """Upright: a hull with a pointed nose and three or four fins, boosters between them or none."""
    radius = rng.uniform(0.2, 0.32)
    nose = rng.uniform(0.45, 0.7)
    parts = [
        rod(HULL, (0, 0, 0), (0, 1.75, 0), radius, radius * rng.uniform(0.85, 1.0)),
        rod(HULL, (0, -0.15, 0), (0, 0.05, 0), 0.75 * radius, 0.5 * radius),
        rod(NOSE, (0, 1.72, 0), (0, 1.75 + nose, 0), 0.85 * radius, 0.15 * radius, rounding=0.02),
    ]
    count = int(rng.integers(3, 5))
    reach, boosters, turn = radius + rng.uniform(0.25, 0.45), rng.random() < 0.4, rng.uniform(0, 2 * np.pi)
    height = rng.uniform(0.2, 0.3)
    for angle in turn + 2 * np.pi * np.arange(count) / count:
        turned = rotation_about((0, 1, 0), angle)
        root, tip = turned @ [0.5 * radius, 0.35, 0], turned @ [reach, 0.05, 0]
        parts.append(bar(FIN, root, tip, 0.035, height))
        if boosters:
            x, _, z = rotation_about((0, 1, 0), angle + np.pi / count) @ [radius + 0.09, 0, 0]
            parts.append(rod(HULL, (x, 0.0, z), (x, 0.9, z), 0.12, 0.08))
    return parts
