"""Airplanes, rockets, motorbikes and skateboards."""

from collections.abc import Iterator

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, ball, bar, box, path, ring, rod, rotation_about, shift

BODY, WING, TAIL, ENGINE = CATEGORIES[category_index("airplane")].labels
HULL, FIN, NOSE = CATEGORIES[category_index("rocket")].labels
TANK, SEAT, WHEEL, HANDLE, LIGHT, FRAME = CATEGORIES[category_index("motorbike")].labels
SKATE_WHEEL, DECK, TRUCK = CATEGORIES[category_index("skateboard")].labels


def airplane(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build an airplane with swept wings, and engines below the wings (two or four) or at the rear (two)."""
    radius, sweep = rng.uniform(0.12, 0.17), rng.uniform(0.1, 0.6)
    yield rod(BODY, (-0.55, 0, 0), (0.85, 0, 0), radius, rounding=0.0)
    yield rod(BODY, (0.83, 0, 0), (1.22, -0.02, 0), radius, 0.35 * radius, rounding=0.03)
    yield rod(BODY, (-1.25, 0.06, 0), (-0.53, 0, 0), 0.4 * radius, radius)
    span, chord, height = rng.uniform(0.95, 1.25), rng.uniform(0.17, 0.24), rng.choice([-0.5, 0.6]) * radius
    dihedral, kind = rng.uniform(0.0, 0.12), rng.choice(["two", "four", "tail"], p=[0.45, 0.3, 0.25])
    size = rng.uniform(0.08, 0.1)
    for side in (-1, 1):
        root, tip = np.array([0.15, height, 0.0]), np.array([0.15 - sweep, height + dihedral, side * span])
        yield bar(WING, root, 0.45 * tip + 0.55 * root, 1.2 * chord, 0.04)
        yield bar(WING, 0.35 * tip + 0.65 * root, tip, 0.8 * chord, 0.033)
        for fraction in {"two": (0.35,), "four": (0.3, 0.6), "tail": ()}[kind]:
            x, y, z = (1 - fraction) * root + fraction * tip
            y -= size + 0.05
            yield rod(ENGINE, (x - 0.1, y, z), (x + 0.3, y, z), 0.85 * size, size)
            yield box(ENGINE, (x + 0.05, y + size, z), (0.12, 0.06, 0.03))
        if kind == "tail":
            z = side * (radius + 0.6 * size)
            yield rod(ENGINE, (-0.8, 0.05, z), (-0.35, 0.05, z), 0.85 * size, size)
    rise = rng.uniform(0.38, 0.5)
    yield bar(TAIL, (-1.0, 0.05, 0), (-1.2, rise, 0), 0.035, 0.15)
    back, level = (-1.2, rise) if kind == "tail" else (-1.08, 0.1)
    reach = rng.uniform(0.36, 0.45)
    for side in (-1, 1):
        yield bar(TAIL, (back, level, 0), (back - 0.15, level, side * reach), 0.12, 0.033)


def rocket(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build an upright rocket with three or four fins, and with or without boosters between the fins."""
    radius, nose = rng.uniform(0.2, 0.32), rng.uniform(0.45, 0.7)
    yield rod(HULL, (0, 0, 0), (0, 1.75, 0), radius, radius * rng.uniform(0.85, 1.0))
    yield rod(HULL, (0, -0.15, 0), (0, 0.05, 0), 0.75 * radius, 0.5 * radius)
    yield rod(NOSE, (0, 1.72, 0), (0, 1.75 + nose, 0), 0.85 * radius, 0.15 * radius, rounding=0.02)
    count = int(rng.integers(3, 5))
    reach, boosters, start_angle = radius + rng.uniform(0.25, 0.45), rng.random() < 0.4, rng.uniform(0, 2 * np.pi)
    height = rng.uniform(0.2, 0.3)
    for angle in start_angle + 2 * np.pi * np.arange(count) / count:
        rotation = rotation_about((0, 1, 0), angle)
        yield bar(FIN, rotation @ [0.5 * radius, 0.35, 0], rotation @ [reach, 0.05, 0], 0.035, height)
        if boosters:
            x, _, z = rotation_about((0, 1, 0), angle + np.pi / count) @ [radius + 0.09, 0, 0]
            yield rod(HULL, (x, 0.0, z), (x, 0.9, z), 0.12, 0.08)


def motorbike(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a motorbike with fork, engine, exhaust, tank, seat, handles, lamp and perhaps a tail light."""
    radius, base, tyre = rng.uniform(0.38, 0.44), rng.uniform(0.74, 0.82), rng.uniform(0.08, 0.11)
    rear, front = np.array([-base, 0.0, 0.0]), np.array([base, 0.0, 0.0])
    for hub in (rear, front):
        yield ring(WHEEL, hub, (0, 0, 1), radius - tyre, tyre, tyre, 0.8 * tyre)
        yield rod(WHEEL, shift(hub, z=-0.035), shift(hub, z=0.035), radius - tyre)
    # The steering head is above the front wheel and behind it, because the fork is raked.
    head = shift(front, -rng.uniform(0.28, 0.4), rng.uniform(0.78, 0.86))
    half_gap = tyre + 0.05
    for joint in (rear, front, head):
        yield rod(FRAME, shift(joint, z=-half_gap), shift(joint, z=half_gap), 0.04)
    for side in (-1, 1):
        yield rod(FRAME, shift(front, z=side * half_gap), shift(head, z=side * half_gap), 0.04)
        yield rod(FRAME, shift(rear, z=side * half_gap), (-0.1, 0.1, side * half_gap), 0.04)
    yield box(FRAME, (0.0, 0.12, 0), (0.3, 0.2, 0.15), 0.08)
    yield box(FRAME, (0.05, 0.36, 0), (0.16, 0.12, 0.11), 0.04, ((0, 0, 1), rng.uniform(-0.3, 0.3)))
    yield bar(FRAME, (-0.5, 0.42, 0), shift(head, y=-0.05), 0.06, 0.06)
    side, exhaust = rng.choice([-1, 1]), rng.uniform(0.05, 0.25)
    yield rod(FRAME, (0.1, 0.0, side * 0.2), (-base - 0.15, exhaust, side * 0.2), 0.05, 0.08)
    yield box(TANK, (0.17, 0.62, 0), (rng.uniform(0.26, 0.32), 0.14, 0.15), 0.12, ((0, 0, 1), 0.15))
    yield box(SEAT, (-0.36, 0.54, 0), (0.28, 0.08, 0.14), 0.06)
    end = np.array([-0.95, rng.uniform(0.62, 0.75), 0])
    yield bar(SEAT, (-0.55, 0.56, 0), end, 0.12, 0.07, 0.06)
    grip = shift(head, -rng.uniform(0.05, 0.25), rng.uniform(0.12, 0.3))
    reach = rng.uniform(0.4, 0.46)
    for across in (-1, 1):
        points = [head, shift(grip, 0.05, 0.0, 0.2 * across), shift(grip, -0.1, -0.02, reach * across)]
        yield from path(HANDLE, points, 0.04)
    lamp = rng.uniform(0.12, 0.15)
    yield rod(LIGHT, shift(head, y=0.02), shift(head, 0.22, 0.02), 0.75 * lamp, lamp, 0.04)
    if rng.random() < 0.6:
        yield ball(LIGHT, shift(end, -0.02, -0.03), rng.uniform(0.08, 0.1))


def skateboard(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a skateboard: a deck with raised or flat ends, on two trucks with two wheels each."""
    half_width, flat = rng.uniform(0.3, 0.4), rng.uniform(0.7, 0.9)
    rise, end, thick = rng.choice([0.0, rng.uniform(0.1, 0.3)]), rng.uniform(0.3, 0.4), rng.uniform(0.035, 0.05)
    yield box(DECK, (0, 0, 0), (flat, thick, half_width), 0.03)
    base, track = 0.75 * flat, 0.8 * half_width
    radius, width, drop = rng.uniform(0.1, 0.15), rng.uniform(0.06, 0.09), rng.uniform(0.18, 0.24)
    for side in (-1, 1):
        yield bar(DECK, (side * (flat - 0.03), 0, 0), (side * (flat + end), rise, 0), 0.9 * half_width, thick, 0.03)
        x = side * base
        yield box(TRUCK, (x, -0.5 * drop, 0), (0.13, 0.5 * drop, 0.12))
        yield rod(TRUCK, (x, -drop, -track), (x, -drop, track), 0.05)
        for end_side in (-1, 1):
            z = end_side * track
            yield rod(SKATE_WHEEL, (x, -drop, z - width), (x, -drop, z + width), radius, rounding=0.03)
