"""Chairs, tables and lamps."""

from collections.abc import Iterator

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, bar, box, path, ring, rod

BACK, SEAT, LEG, ARM = CATEGORIES[category_index("chair")].labels
TOP, TABLE_LEG, DRAWER = CATEGORIES[category_index("table")].labels
BASE, SHADE, CANOPY, TUBE = CATEGORIES[category_index("lamp")].labels


def chair(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a chair on legs, a star base or runners, with a panel or slats behind and perhaps armrests."""
    half_width, half_depth = rng.uniform(0.5, 0.65), rng.uniform(0.5, 0.62)
    height, rise = rng.uniform(0.9, 1.15), rng.uniform(1.0, 1.4)
    thick, lean = rng.uniform(0.05, 0.09), rng.uniform(0.05, 0.3)
    yield box(SEAT, (0, height, 0), (half_depth, thick, half_width), rng.uniform(0.02, thick))
    yield from _chair_legs(rng, half_width, half_depth, height - thick)
    yield from _chair_back(rng, half_width, half_depth, height, rise, lean)
    if rng.random() < 0.6:
        top, front = height + rng.uniform(0.4, 0.6), rng.uniform(0.1, 0.9) * half_depth
        behind = -half_depth + 0.05 - lean * (top - height) / rise
        for side in (-1, 1):
            z = side * (half_width - 0.02)
            yield bar(ARM, (behind, top, z), (front, top, z), 0.07, 0.045, 0.03)
            yield bar(ARM, (front - 0.1, height, z), (front - 0.1, top, z), 0.045, 0.045, 0.02)


def _chair_legs(rng, half_width, half_depth, height):
    kind = rng.choice(["legs", "star", "runners"], p=[0.5, 0.3, 0.2])
    x, z, splay = half_depth - 0.08, half_width - 0.08, rng.uniform(0.0, 0.12)
    corners = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    if kind == "star":
        yield rod(LEG, (0, 0.12, 0), (0, height + 0.02, 0), rng.uniform(0.06, 0.1))
        reach, start_angle = rng.uniform(0.5, 0.62), rng.uniform(0, 2 * np.pi)
        for angle in start_angle + 2 * np.pi * np.arange(5) / 5:
            yield bar(LEG, (0, 0.14, 0), (reach * np.cos(angle), 0.06, reach * np.sin(angle)), 0.05, 0.045)
        return
    radius = rng.uniform(0.045, 0.07)
    feet = [(a * (x + splay), 0.0, b * (z + splay)) for a, b in corners]
    tops = [(a * x, height + 0.03, b * z) for a, b in corners]
    if kind == "runners":
        yield from (bar(LEG, foot, top, radius, radius) for foot, top in zip(feet, tops, strict=True))
        for b in (-z - splay, z + splay):
            yield bar(LEG, (-x - splay - radius, 0.03, b), (x + splay + radius, 0.03, b), radius, 0.05)
        return
    taper = rng.uniform(0.7, 1.0)
    yield from (rod(LEG, foot, top, max(0.04, taper * radius), radius) for foot, top in zip(feet, tops, strict=True))
    if rng.random() < 0.4:
        y = rng.uniform(0.25, 0.5) * height
        half_x, half_z = x + splay * (1 - y / height), z + splay * (1 - y / height)
        yield from (rod(LEG, (-half_x, y, b * half_z), (half_x, y, b * half_z), 0.04) for b in (-1, 1))


def _chair_back(rng, half_width, half_depth, height, rise, lean):
    x, thick = -half_depth + 0.06, rng.uniform(0.04, 0.06)

    def point_at(level, z):
        return (x - lean * level, height + rise * level, z)

    if rng.random() < 0.5:
        gap = rng.choice([0.0, 0.25])
        yield bar(BACK, point_at(gap, 0.0), point_at(1.0, 0.0), half_width - 0.02, thick, 0.03)
        for z in (-0.5 * half_width, 0.5 * half_width) if gap else ():
            yield bar(BACK, point_at(0.0, z), point_at(0.4, z), 0.05, thick)
        return
    z = half_width - 0.06
    yield from (bar(BACK, point_at(0.0, side * z), point_at(1.0, side * z), 0.06, 0.05) for side in (-1, 1))
    if rng.random() < 0.5:
        yield bar(BACK, point_at(0.85, 0.0), point_at(1.0, 0.0), z, thick)
        for fraction in np.linspace(-1, 1, int(rng.integers(2, 4)) + 2)[1:-1]:
            yield bar(BACK, point_at(0.0, fraction * z), point_at(0.9, fraction * z), 0.05, 0.035)
        return
    yield from (bar(BACK, point_at(c - 0.08, 0.0), point_at(c + 0.08, 0.0), z, 0.035) for c in (0.4, 0.65, 0.92))


def table(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a rectangular or round table on legs, a pedestal or panels, perhaps with drawers or a shelf."""
    height, thick = rng.uniform(1.0, 1.5), rng.uniform(0.045, 0.08)
    if rng.random() < 0.3:
        radius = rng.uniform(0.95, 1.2)
        yield rod(TOP, (0, height - thick, 0), (0, height + thick, 0), radius, rounding=0.03)
        if rng.random() < 0.6:
            foot, column = rng.uniform(0.5, 0.7) * radius, rng.uniform(0.08, 0.14)
            yield rod(TABLE_LEG, (0, 0.05, 0), (0, height, 0), column * rng.uniform(1.0, 1.6), column)
            yield rod(TABLE_LEG, (0, 0.0, 0), (0, 0.12, 0), foot, 0.85 * foot, rounding=0.03)
        else:
            yield from _table_legs(rng, 0.65 * radius, 0.65 * radius, height)
        return
    half_depth, half_width = rng.uniform(0.55, 0.8), rng.uniform(0.95, 1.25)
    yield box(TOP, (0, height, 0), (half_depth, thick, half_width), 0.02)
    if rng.random() < 0.3:
        for side in (-1, 1):
            z = side * (half_width - 0.15)
            yield box(TABLE_LEG, (0, 0.5 * height, z), (half_depth - 0.08, 0.5 * height, 0.05))
    else:
        yield from _table_legs(rng, half_depth - 0.1, half_width - 0.1, height)
    extra = rng.choice(["drawer", "drawers", "shelf", "none"])
    if extra == "shelf":
        y = rng.uniform(0.2, 0.4) * height
        yield box(DRAWER, (0, y, 0), (half_depth - 0.12, 0.045, half_width - 0.12))
    elif extra != "none":
        half = np.array([0.7 * half_depth, rng.uniform(0.12, 0.2), rng.uniform(0.25, 0.35)])
        for z in [0.0] if extra == "drawer" else [-0.5 * half_width, 0.5 * half_width]:
            y = height - thick - half[1] + 0.02
            yield box(DRAWER, (0.15 * half_depth, y, z), half)
            yield box(DRAWER, (0.85 * half_depth + 0.02, y, z), (0.05, 0.035, 0.09))


def _table_legs(rng, x, z, height):
    radius, taper, square = rng.uniform(0.05, 0.09), rng.uniform(0.7, 1.0), rng.random() < 0.5
    for a, b in ((-x, -z), (-x, z), (x, -z), (x, z)):
        foot, top = (a, 0.0, b), (a, height, b)
        if square:
            yield bar(TABLE_LEG, foot, top, radius, radius)
        else:
            yield rod(TABLE_LEG, foot, top, max(0.045, taper * radius), radius)


def lamp(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a standing lamp, a desk lamp with a bent arm, or a hanging lamp. The shade is open below."""
    kind, tube = rng.choice(["standing", "desk", "hanging"], p=[0.4, 0.3, 0.3]), rng.uniform(0.045, 0.07)
    if kind == "desk":
        yield from _desk_lamp(rng, tube)
        return
    narrow, wide, tall = rng.uniform(0.3, 0.5), rng.uniform(0.55, 0.85), rng.uniform(0.6, 0.9)
    if kind == "hanging":
        drop, cap = rng.uniform(0.9, 1.4), rng.uniform(0.22, 0.35)
        yield rod(TUBE, (0, tall - 0.1, 0), (0, tall + drop, 0), tube)
        yield rod(CANOPY, (0, tall + drop - rng.uniform(0.12, 0.25), 0), (0, tall + drop, 0), 0.5 * cap, cap)
        yield rod(SHADE, (0, tall - 0.06, 0), (0, tall, 0), narrow + 0.03)
        yield _shade((0, 0, 0), (0, tall, 0), wide, narrow)
        return
    pole, foot = rng.uniform(1.2, 1.7), rng.uniform(0.4, 0.6)
    low, high = pole - 0.5 * tall, pole + 0.5 * tall
    yield rod(TUBE, (0, 0.05, 0), (0, pole, 0), tube)
    yield rod(BASE, (0, 0, 0), (0, rng.uniform(0.1, 0.3), 0), foot, rng.uniform(0.4, 0.9) * foot)
    # Two crossing spokes carry the shade.
    reach = 0.5 * (narrow + wide)
    yield rod(TUBE, (0, pole, -reach), (0, pole, reach), 0.035)
    yield rod(TUBE, (-reach, pole, 0), (reach, pole, 0), 0.035)
    yield _shade((0, low, 0), (0, high, 0), wide, narrow)


def _desk_lamp(rng, tube):
    foot = rng.uniform(0.4, 0.55)
    elbow = np.array([rng.uniform(-0.5, -0.3), rng.uniform(1.0, 1.3), 0.0])
    head = np.array([rng.uniform(0.5, 0.7), rng.uniform(1.6, 1.9), 0.0])
    down = np.array([rng.uniform(0.3, 0.7), -1.0, 0.0])
    down /= np.linalg.norm(down)
    tall, narrow, wide = rng.uniform(0.45, 0.6), rng.uniform(0.15, 0.22), rng.uniform(0.4, 0.5)
    yield rod(BASE, (0, 0, 0), (0, rng.uniform(0.1, 0.16), 0), foot, 0.85 * foot, 0.03)
    yield from path(TUBE, [(0, 0.05, 0), elbow, head], tube)
    yield rod(SHADE, head - 0.08 * down, head + 0.08 * down, narrow + 0.03)
    yield _shade(head + tall * down, head, wide, narrow)


def _shade(low, high, wide, narrow):
    """Build a lamp shade, open at both ends, whose radius is `wide` at `low` and `narrow` at `high`."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    length = float(np.linalg.norm(high - low))
    slant = (narrow - wide) / length
    return ring(SHADE, 0.5 * (low + high), high - low, 0.5 * (narrow + wide), 0.035, 0.5 * length, 0.02, slant)
