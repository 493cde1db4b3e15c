"""Motorbikes."""

import numpy as np

from jaxnbv.networks.categories import CATEGORIES, category_index
from jaxnbv.studies.scenes.labelled import Primitive, ball, bar, box, path, ring, rod, shifted

TANK, SEAT, WHEEL, HANDLE, LIGHT, FRAME = CATEGORIES[category_index("motorbike")].labels


def motorbike(rng: np.random.Generator) -> list[Primitive]:
    """Two wheels, a fork, an engine with exhaust, a tank, a seat, handles, a head light and perhaps a tail light."""
    radius, base, tyre = rng.uniform(0.38, 0.44), rng.uniform(0.74, 0.82), rng.uniform(0.08, 0.11)
    rear, front = np.array([-base, 0.0, 0.0]), np.array([base, 0.0, 0.0])
    parts = []
    for hub in (rear, front):
        parts.append(ring(WHEEL, hub, (0, 0, 1), radius - tyre, tyre, tyre, 0.8 * tyre))
        parts.append(rod(WHEEL, shifted(hub, z=-0.035), shifted(hub, z=0.035), radius - tyre))
    # The steering head stands behind and above the front wheel by the fork's rake.
    head = shifted(front, -rng.uniform(0.28, 0.4), rng.uniform(0.78, 0.86))
    apart = tyre + 0.05
    for joint in (rear, front, head):
        parts.append(rod(FRAME, shifted(joint, z=-apart), shifted(joint, z=apart), 0.04))
    for side in (-1, 1):
        parts.append(rod(FRAME, shifted(front, z=side * apart), shifted(head, z=side * apart), 0.04))
        parts.append(rod(FRAME, shifted(rear, z=side * apart), (-0.1, 0.1, side * apart), 0.04))
    parts.append(box(FRAME, (0.0, 0.12, 0), (0.3, 0.2, 0.15), 0.08))
    parts.append(box(FRAME, (0.05, 0.36, 0), (0.16, 0.12, 0.11), 0.04, ((0, 0, 1), rng.uniform(-0.3, 0.3))))
    parts.append(bar(FRAME, (-0.5, 0.42, 0), shifted(head, y=-0.05), 0.06, 0.06))
    side = rng.choice([-1, 1])
    exhaust = rng.uniform(0.05, 0.25)
    parts.append(rod(FRAME, (0.1, 0.0, side * 0.2), (-base - 0.15, exhaust, side * 0.2), 0.05, 0.08))
    parts.append(box(TANK, (0.17, 0.62, 0), (rng.uniform(0.26, 0.32), 0.14, 0.15), 0.12, ((0, 0, 1), 0.15)))
    parts.append(box(SEAT, (-0.36, 0.54, 0), (0.28, 0.08, 0.14), 0.06))
    end = np.array([-0.95, rng.uniform(0.62, 0.75), 0])
    parts.append(bar(SEAT, (-0.55, 0.56, 0), end, 0.12, 0.07, 0.06))
    grip = shifted(head, -rng.uniform(0.05, 0.25), rng.uniform(0.12, 0.3))
    reach = rng.uniform(0.4, 0.46)
    for across in (-1, 1):
        points = [head, shifted(grip, 0.05, 0.0, 0.2 * across), shifted(grip, -0.1, -0.02, reach * across)]
        parts += path(HANDLE, points, 0.04)
    lamp = rng.uniform(0.12, 0.15)
    parts.append(rod(LIGHT, shifted(head, y=0.02), shifted(head, 0.22, 0.02), 0.75 * lamp, lamp, 0.04))
    if rng.random() < 0.6:
        parts.append(ball(LIGHT, shifted(end, -0.02, -0.03), rng.uniform(0.08, 0.1)))
    return parts
