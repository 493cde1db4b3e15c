"""Procedural objects of the ten classes of ModelNet10, which differ in global shape."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from jaxnbv.studies.scenes import labelled
from jaxnbv.studies.scenes.class_object import SolidObject
from jaxnbv.studies.scenes.framing import Framing
from jaxnbv.studies.scenes.labelled import assemble, generator
from jaxnbv.studies.scenes.parts import furniture
from jaxnbv.studies.scenes.splits import Split, scene_key

# Labels above 0 mark the cue, which tells an object's class. Here it is the whole object.
ball, bar, box, ring, rod = (
    partial(make, 1) for make in (labelled.ball, labelled.bar, labelled.box, labelled.ring, labelled.rod)
)
path = partial(labelled.path, 1)


def household_scene(
    split: Split, index: int, framing: Framing = Framing.CLOSE_UP, is_rotated: bool = True
) -> SolidObject:
    """Return the random household object with this index in a split, of class `HOUSEHOLD[index % 10]`.

    The object stands upright along y. If `is_rotated`, it is rotated about y by a random angle, else it faces x. Its
    bounding box is centred. At a longest side of 2.5, no primitive is thinner than 0.05. The object is built on the
    host, so the function does not run under `jit`.

    **Raises:** `ValueError` if the index is negative.
    """
    label, rng = index % len(HOUSEHOLD), generator(scene_key(6, split, index))
    primitives = list(BUILDERS[HOUSEHOLD[label]](rng))
    solid = assemble(primitives, rng.uniform(-np.pi, np.pi) if is_rotated else 0.0, framing.longest_side)
    return SolidObject(solid=solid, label=jnp.asarray(label))


def _corners(x: float, z: float) -> list[tuple[float, float]]:
    return [(a, b) for a in (-x, x) for b in (-z, z)]


def _bathtub(rng):
    """Build a bathtub: a basin on feet or on a plinth, with or without a rim and a tap."""
    x, z, height, wall = rng.uniform(0.42, 0.52), rng.uniform(0.95, 1.15), rng.uniform(0.25, 0.34), 0.06
    soft = rng.uniform(0.02, 0.06)
    yield box((0, -height + wall, 0), (x - 0.02, wall, z - 0.02), soft)
    yield from (box((side * (x - wall), 0, 0), (wall, height, z), soft) for side in (-1, 1))
    yield from (box((0, 0, side * (z - wall)), (x, height, wall), soft) for side in (-1, 1))
    if rng.random() < 0.6:
        reach = rng.uniform(0.03, 0.07)
        yield from (box((side * (x - wall), height, 0), (wall + reach, 0.04, z + reach)) for side in (-1, 1))
        yield from (box((0, height, side * (z - wall)), (x + reach, 0.04, wall + reach)) for side in (-1, 1))
    if rng.random() < 0.5:
        yield from (ball((a, -height - 0.04, b), 0.1) for a, b in _corners(x - 0.14, z - 0.2))
    else:
        yield box((0, -height - 0.05, 0), (x - 0.06, 0.1, z - 0.06))
    if rng.random() < 0.5:
        top = height + rng.uniform(0.2, 0.3)
        yield from path([(0, height - 0.1, z - wall), (0, top, z - wall), (0, top - 0.03, z - 0.32)], 0.04)


def _bed(rng):
    """Build a bed: a mattress in a frame with pillows, a headboard, and perhaps a lower footboard."""
    x, z, level = rng.uniform(0.95, 1.15), rng.uniform(0.45, 0.9), rng.uniform(0.2, 0.35)
    thick, frame = rng.uniform(0.09, 0.16), 0.07
    yield box((0, level, 0), (x, frame, z))
    yield box((0, level + frame + thick - 0.02, 0), (x - 0.04, thick, z - 0.04), rng.uniform(0.03, 0.08))
    if rng.random() < 0.6:
        yield from (bar((a, 0, b), (a, level, b), 0.05, 0.05) for a, b in _corners(x - 0.07, z - 0.07))
    else:
        yield box((0, 0.5 * level, 0), (x - 0.1, 0.5 * level, z - 0.1))
    rise = rng.uniform(0.35, 0.7)
    yield box((-x, 0.5 * (level + rise), 0), (0.04, 0.5 * (level + rise), z))
    if rng.random() < 0.5:
        low = level + rng.uniform(0.12, 0.3)
        yield box((x, 0.5 * low, 0), (0.04, 0.5 * low, z))
    top = level + frame + 2 * thick
    places = (0.0,) if z < 0.6 else (-0.48 * z, 0.48 * z)
    half = 0.6 * z if z < 0.6 else 0.38 * z
    yield from (box((-x + 0.25, top + 0.01, b), (0.16, 0.07, half), 0.06) for b in places)


def _desk(rng):
    """Build a desk with a back panel, on two chests of drawers, or on one chest and legs or a panel."""
    x, z, height, thick = rng.uniform(0.45, 0.6), rng.uniform(0.95, 1.2), rng.uniform(0.9, 1.1), 0.05
    yield box((0, height, 0), (x, thick, z))
    sides = (-1, 1) if rng.random() < 0.5 else (rng.choice([-1, 1]),)
    half, gap = rng.uniform(0.22, 0.3), rng.choice([0.05, 0.35])
    for side in sides:
        middle, centre = 0.5 * (gap + height), side * (z - half - 0.04)
        yield box((0, middle, centre), (x - 0.06, 0.5 * (height - gap), half))
        count = int(rng.integers(2, 4))
        tall = (height - gap) / count
        for place in range(count):
            y = gap + (place + 0.5) * tall
            yield box((x - 0.05, y, centre), (0.04, 0.5 * tall - 0.03, half - 0.03))
    if len(sides) == 1:
        b = -sides[0] * (z - 0.07)
        if rng.random() < 0.5:
            yield from (bar((a, 0, b), (a, height, b), 0.045, 0.045) for a in (-x + 0.07, x - 0.07))
        else:
            yield box((0, 0.5 * height, b), (x - 0.06, 0.5 * height, 0.04))
    low = rng.uniform(0.3, 0.6) * height
    yield box((-x + 0.08, 0.5 * (low + height), 0), (0.035, 0.5 * (height - low), z - 0.06))


def _dresser(rng):
    """Build a dresser: a wide chest on feet or a plinth, with two or three columns of drawers with knobs."""
    x, z, height = rng.uniform(0.32, 0.42), rng.uniform(0.85, 1.1), rng.uniform(0.45, 0.6)
    yield box((0, 0, 0), (x, height, z))
    yield box((0.02, height + 0.02, 0), (x + 0.05, 0.045, z + 0.04))
    columns, rows = int(rng.integers(2, 4)), int(rng.integers(2, 4))
    rows = 2 if columns == 3 else rows
    wide, tall = 2 * z / columns, 2 * height / rows
    for column in range(columns):
        for row in range(rows):
            y, b = -height + (row + 0.5) * tall, -z + (column + 0.5) * wide
            yield box((x + 0.01, y, b), (0.035, 0.5 * tall - 0.03, 0.5 * wide - 0.03))
            yield ball((x + 0.07, y, b), 0.045)
    if rng.random() < 0.5:
        yield from (bar((a, -height - 0.18, b), (a, -height, b), 0.05, 0.05) for a, b in _corners(x - 0.08, z - 0.08))
    else:
        yield box((0, -height - 0.04, 0), (x - 0.04, 0.08, z - 0.04))


def _monitor(rng):
    """Build a monitor: a flat screen with a frame, on a neck with a round or square foot."""
    z, height, thick = rng.uniform(0.85, 1.1), rng.uniform(0.5, 0.7), rng.uniform(0.05, 0.08)
    tilt = rng.uniform(0.0, 0.15)
    level, lean, rim = height + rng.uniform(0.25, 0.4), ((0.0, 0.0, 1.0), tilt), 0.05
    yield box((0, level, 0), (thick, height, z), 0.03, lean)
    out = np.array([np.cos(tilt), np.sin(tilt), 0.0]) * (thick + 0.02)
    for side in (-1, 1):
        offset = np.array([-np.sin(tilt), np.cos(tilt), 0.0]) * side * (height - rim)
        yield box(np.array([0, level, 0]) + out + offset, (0.03, rim, z), 0.02, lean)
        yield box(np.array([0, level, side * (z - rim)]) + out, (0.03, height, rim), 0.02, lean)
    if rng.random() < 0.5:
        yield box((-thick - 0.04, level, 0), (0.08, 0.5 * height, 0.5 * z), 0.04)
    neck = rng.uniform(0.06, 0.12)
    yield bar((-0.08, 0.03, 0), (-0.06, level - 0.3 * height, 0), neck, 0.05)
    foot = rng.uniform(0.3, 0.45)
    if rng.random() < 0.5:
        yield rod((0, 0, 0), (0, 0.08, 0), foot, 0.85 * foot)
    else:
        yield box((0, 0.04, 0), (0.75 * foot, 0.04, 1.2 * foot))


def _night_stand(rng):
    """Build a night stand: a chest on legs, as high as wide, with two drawers, or one and an open shelf."""
    x, z, height, legs = rng.uniform(0.55, 0.7), rng.uniform(0.6, 0.75), rng.uniform(0.5, 0.7), rng.uniform(0.25, 0.6)
    wall, top = 0.05, legs + 2 * height
    yield box((0, top, 0), (x + 0.06, wall, z + 0.06))
    yield box((0, legs, 0), (x, wall, z))
    yield from (box((0, legs + height, b), (x, height, wall)) for b in (-z + wall, z - wall))
    yield box((-x + wall, legs + height, 0), (wall, height, z))
    rows = 2 if rng.random() < 0.5 else 1
    tall = height if rows == 2 else rng.uniform(0.7, 1.1) * height
    for row in range(rows):
        y = top - wall - (row + 0.5) * tall
        yield box((0, y, 0), (x + 0.02, 0.5 * tall - 0.03, z - 0.07))
        yield ball((x + 0.07, y, 0), 0.08)
    thick = rng.uniform(0.05, 0.08)
    yield from (bar((a, 0, b), (a, legs, b), thick, thick) for a, b in _corners(x - thick, z - thick))


def _sofa(rng):
    """Build a sofa: two or three seats with cushions between arms, and a back with or without cushions."""
    x, z, seat = rng.uniform(0.4, 0.52), rng.uniform(0.85, 1.15), rng.uniform(0.18, 0.26)
    rise, arm = rng.uniform(0.35, 0.55), rng.uniform(0.1, 0.16)
    soft = rng.uniform(0.03, 0.08)
    yield box((0, seat, 0), (x, 0.16, z), soft)
    yield box((-x + 0.06, seat + 0.5 * rise, 0), (0.12, 0.5 * rise + 0.1, z), soft)
    high = rng.uniform(0.15, 0.28)
    yield from (box((0.02, seat + high, b), (x, high + 0.14, arm), soft) for b in (-z, z))
    count = 2 if z < 0.95 else 3
    wide = (z - arm) / count
    for place in range(count):
        b = -z + arm + (2 * place + 1) * wide
        yield box((0.08, seat + 0.2, b), (x - 0.06, 0.08, wide - 0.01), 0.05)
        if rise > 0.42:
            yield box((-x + 0.26, seat + 0.28 + 0.4 * rise, b), (0.1, 0.4 * rise, wide - 0.02), 0.07)
    yield from (bar((a, 0, b), (a, seat, b), 0.05, 0.05) for a, b in _corners(x - 0.1, z - 0.08))


def _toilet(rng):
    """Build a toilet: a bowl on a foot, with a seat, a lid (open or shut), and a tank behind the bowl."""
    bowl, level = rng.uniform(0.4, 0.48), rng.uniform(0.55, 0.7)
    deep, slant = 0.2, rng.uniform(0.3, 0.6)
    foot = rng.uniform(0.22, 0.3)
    yield ring((0.1, level - deep, 0), (0, 1, 0), bowl - 0.08 - slant * deep, 0.07, deep, 0.03, slant)
    yield rod((0.1, level - 2 * deep - 0.02, 0), (0.1, level - deep, 0), bowl - 2 * slant * deep, bowl - 0.12)
    yield rod((0.05, 0, 0), (0.05, level - 2 * deep + 0.05, 0), foot, 0.85 * foot)
    yield ring((0.1, level + 0.02, 0), (0, 1, 0), bowl - 0.06, 0.1, 0.04, 0.03)
    z, tall = rng.uniform(0.4, 0.55), rng.uniform(0.3, 0.42)
    behind = 0.1 - bowl - 0.2
    yield box((behind, level + tall, 0), (0.16, tall, z), 0.04)
    yield box((behind, level + 2 * tall, 0), (0.19, 0.04, z + 0.03))
    yield box((behind + 0.15, level - 0.05, 0), (0.3, 0.09, 0.22))
    if rng.random() < 0.5:
        lean = rng.uniform(0.0, 0.15)
        lid = np.array([behind + 0.21 + 0.5 * lean * bowl, level + 0.06 + bowl, 0.0])
        out = np.array([np.cos(lean), np.sin(lean), 0.0])
        yield rod(lid - 0.035 * out, lid + 0.035 * out, bowl)
        return
    # Fill the bowl if the lid is shut, because no view can see into it.
    yield rod((0.1, level - deep, 0), (0.1, level + 0.07, 0), bowl - 0.1)
    yield rod((0.1, level + 0.05, 0), (0.1, level + 0.12, 0), bowl + 0.02)


# Each function yields the primitives of a random object. x is forward, y up and z to the right.
BUILDERS = {
    "bathtub": _bathtub,
    "bed": _bed,
    "chair": furniture.chair,
    "desk": _desk,
    "dresser": _dresser,
    "monitor": _monitor,
    "night stand": _night_stand,
    "sofa": _sofa,
    "table": furniture.table,
    "toilet": _toilet,
}

# The classes, in the order of ModelNet10.
HOUSEHOLD = tuple(BUILDERS)
