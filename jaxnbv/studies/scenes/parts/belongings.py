"""Bags, guitars, headphones, laptops, mugs and pistols."""

from collections.abc import Iterator

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, bar, box, path, ring, rod, shift

BAG_HANDLE, BAG_BODY = CATEGORIES[category_index("bag")].labels
CUP, BAND, WIRE = CATEGORIES[category_index("earphone")].labels
HEAD, NECK, BODY = CATEGORIES[category_index("guitar")].labels
KEYBOARD, SCREEN = CATEGORIES[category_index("laptop")].labels
MUG_HANDLE, MUG_BODY = CATEGORIES[category_index("mug")].labels
BARREL, GRIP, TRIGGER = CATEGORIES[category_index("pistol")].labels


def bag(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a bag: a box or a roll with one or two handles on top, with or without a pocket in front."""
    half_width, handles = rng.uniform(0.8, 1.1), int(rng.integers(1, 3))
    half_height, half_depth = rng.uniform(0.5, 0.75), rng.uniform(0.22, 0.4)
    if rng.random() < 0.3:
        half_depth = half_height = rng.uniform(0.45, 0.6)
        yield rod(BAG_BODY, (0, 0, -half_width), (0, 0, half_width), half_height, rounding=0.12)
    else:
        yield box(BAG_BODY, (0, 0, 0), (half_depth, half_height, half_width), rng.uniform(0.05, 0.2))
    if rng.random() < 0.5:
        half = (0.1, rng.uniform(0.3, 0.5) * half_height, rng.uniform(0.4, 0.7) * half_width)
        yield box(BAG_BODY, (half_depth, -0.3 * half_height, 0), half, 0.06)
    rise, span, radius = rng.uniform(0.5, 0.8), rng.uniform(0.4, 0.7) * half_width, rng.uniform(0.06, 0.09)
    angle = np.linspace(0, np.pi, 7)
    for x in [0.0] if handles == 1 else [-0.5 * half_depth, 0.5 * half_depth]:
        root = half_height - 0.02 if handles == 1 else 0.85 * half_height
        points = np.stack([np.full(7, x), root + rise * np.sin(angle) ** 0.7, span * np.cos(angle)], axis=-1)
        yield from path(BAG_HANDLE, points, radius)


def guitar(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build an upright guitar with pegs and the strings in front. Its body has a waist and may have horns."""
    lower, upper = rng.uniform(0.42, 0.52), rng.uniform(0.32, 0.4)
    depth, thin = rng.uniform(0.08, 0.16), rng.uniform(0.04, 0.055)
    waist, neck = rng.uniform(0.5, 0.6), rng.uniform(0.95, 1.15)
    yield rod(BODY, (-depth, 0.0, 0.0), (depth, 0.0, 0.0), lower, rounding=0.04)
    yield rod(BODY, (-depth, waist, 0.0), (depth, waist, 0.0), upper, rounding=0.04)
    yield box(BODY, (0, 0.5 * waist, 0), (depth, 0.3, 0.7 * upper))
    top = waist + upper
    for side in (-1, 1) if rng.random() < 0.4 else ():
        yield bar(BODY, (0, waist, side * 0.2), (0, top + 0.1, side * 0.3), 0.07, depth, 0.05)
    front = depth + thin - 0.02
    yield box(BODY, (front, -0.1, 0), (thin, 0.045, 0.2))
    yield bar(NECK, (front, 0.5 * waist, 0), (front, top + neck, 0), rng.uniform(0.07, 0.09), thin + 0.01)
    tilt, length = rng.uniform(0.0, 0.1), rng.uniform(0.3, 0.4)
    crown = (front - tilt, top + neck + length, 0)
    yield bar(HEAD, (front, top + neck, 0), crown, rng.uniform(0.11, 0.15), 0.05)
    for fraction in (0.25, 0.55, 0.85):
        x, y = front - fraction * tilt, top + neck + fraction * length
        yield rod(HEAD, (x, y, -0.22), (x, y, 0.22), 0.035)


def earphone(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build headphones: two cups under an arched band, with or without a hanging wire."""
    half_width, rise = rng.uniform(0.75, 0.95), rng.uniform(0.95, 1.2)
    radius, thick, width = rng.uniform(0.32, 0.42), rng.uniform(0.1, 0.16), rng.uniform(0.06, 0.09)
    angle = np.linspace(0, np.pi, 9)
    points = np.stack([np.zeros(9), rise * np.sin(angle), half_width * np.cos(angle)], axis=-1)
    yield from path(BAND, points, width)
    for side in (-1, 1):
        z = side * half_width
        yield rod(CUP, (0, -0.1, z - thick), (0, -0.1, z + thick), radius, rounding=0.06)
        yield ring(CUP, (0, -0.1, z - side * (thick + 0.04)), (0, 0, 1), radius - 0.1, 0.07, 0.07, 0.06)
    if rng.random() < 0.7:
        z, low = rng.choice([-1, 1]) * half_width, -0.1 - radius
        swing = rng.uniform(-0.2, 0.2, 2)
        end = (swing[0] + 0.1, low - rng.uniform(0.6, 0.9), z + swing[1])
        yield from path(WIRE, [(0, low + 0.05, z), (0.05, low - 0.3, z), end], 0.04)


def laptop(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a laptop that is open at an angle of 90 to 130 degrees."""
    half_width, half_depth, thick = rng.uniform(1.1, 1.25), rng.uniform(0.7, 0.9), rng.uniform(0.04, 0.06)
    lean = rng.uniform(0.0, np.radians(40))
    hinge = np.array([-half_depth + 0.03, 0.0, 0.0])
    top = hinge + 2 * half_depth * np.array([-np.sin(lean), np.cos(lean), 0.0])
    yield box(KEYBOARD, (0, 0, 0), (half_depth, thick, half_width), 0.03)
    yield bar(SCREEN, hinge, top, half_width, 0.035, 0.03)


def pistol(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a pistol with slide, barrel, slanted grip and trigger guard. It may have a revolver's drum."""
    half, length, drop = rng.uniform(0.13, 0.17), rng.uniform(0.9, 1.1), rng.uniform(0.75, 0.95)
    yield box(BARREL, (0.1, 0, 0), (length, half, 0.75 * half), 0.04)
    yield rod(BARREL, (length - 0.1, 0.02, 0), (length + rng.uniform(0.2, 0.35), 0.02, 0), 0.08)
    yield box(BARREL, (0.9 * length, half, 0), (0.06, 0.06, 0.03))
    if rng.random() < 0.4:
        yield rod(BARREL, (-0.25, 0, 0), (0.25, 0, 0), rng.uniform(1.3, 1.5) * half, rounding=0.04)
    slope, grip = rng.uniform(0.1, 0.35), rng.uniform(0.16, 0.2)
    top = np.array([-length + 0.3, 0.0, 0.0])
    yield bar(GRIP, top, shift(top, -slope, -drop), 0.8 * half, grip, 0.05)
    guard = rng.uniform(0.18, 0.22)
    centre = shift(top, grip + guard - 0.02, -half - guard + 0.06)
    yield ring(TRIGGER, centre, (0, 0, 1), guard, 0.035, 0.05)
    yield bar(TRIGGER, shift(centre, 0.02, guard), shift(centre, 0.06, -0.3 * guard), 0.035, 0.035)


def mug(rng: np.random.Generator) -> Iterator[Primitive]:
    """Build a mug with a hollow body, nearly straight or widening, and a round or square handle behind."""
    radius, half_height = rng.uniform(0.6, 0.85), rng.uniform(0.75, 1.0)
    slant, wall = rng.uniform(-0.05, 0.2), 0.05
    yield ring(MUG_BODY, (0, 0, 0), (0, 1, 0), radius - wall, wall, half_height, 0.03, slant)
    yield rod(MUG_BODY, (0, -half_height, 0), (0, -half_height + 0.12, 0), radius - wall - slant * half_height)
    reach = rng.uniform(0.5, 0.7)
    top, bottom = rng.uniform(0.5, 0.7) * half_height, rng.uniform(-0.7, -0.5) * half_height
    angle = np.linspace(0.5 * np.pi, -0.5 * np.pi, 6)
    # The handle follows an ellipse (power 1) or a superellipse, whose shape is between an ellipse and a square.
    power = rng.choice([1.0, 0.55])
    out = reach * np.cos(angle) ** power
    y = 0.5 * (top + bottom) + 0.5 * (top - bottom) * np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** power
    points = np.stack([-(radius - wall + slant * y) - out, y, np.zeros(6)], axis=-1)
    yield from path(MUG_HANDLE, points, rng.uniform(0.08, 0.12))
