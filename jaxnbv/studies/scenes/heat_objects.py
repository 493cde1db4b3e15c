"""Heated objects. Heat flows through legs, panels, handles or fins, which few views show."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.checks import require
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.scanning import SDFSurface, Surface, scan
from jaxnbv.search import SphereCandidates
from jaxnbv.studies.scenes import labelled
from jaxnbv.studies.scenes.labelled import assemble, generator

# Labels of heated objects are not used.
bar, box, ring, rod = (partial(make, 0) for make in (labelled.bar, labelled.box, labelled.ring, labelled.rod))
path = partial(labelled.path, 0)
FIRST_TRAINING = 100_000


class HeatScene(eqx.Module):
    """A connected object and its heat source.

    - `surface`: surface of the object, which is centred, upright along y, and has longest side 2.5.
    - `name`: kind of the object, such as one of `HEAT_OBJECTS`.
    - `source`: point of the surface (scene coordinates) around which the object is heated.
    """

    surface: Surface
    name: str = eqx.field(static=True)
    source: Float[Array, "3"]


def heat_scene(index: int, is_rotated: bool = True) -> HeatScene:
    """Return the heated scene with this index. Its kind of object is `HEAT_OBJECTS[index % 4]`.

    Proportions and heat source are random. If `is_rotated`, the object is also rotated about y by a random angle.
    Indices from `FIRST_TRAINING` on are for training only. Reported results do not include them.

    **Raises:** `ValueError` if the index is negative.
    """
    require(index >= 0, f"the scene's number is {index}; it must not be negative")
    name = HEAT_OBJECTS[index % len(HEAT_OBJECTS)]
    rng = generator(jax.random.fold_in(jax.random.key(1), index))
    primitives, position = _BUILDERS[name](rng)
    solid = assemble(primitives, rng.uniform(-np.pi, np.pi) if is_rotated else 0.0)
    offset = solid.half_size[0] * jnp.asarray(position)
    source = solid.centre[0] + jnp.matmul(solid.rotation[0], offset, precision="highest")
    return HeatScene(SDFSurface(solid), name, source)


def source_view(scene: HeatScene, key: PRNGKeyArray, num_candidates: int = 100, radius: float = 3.0) -> Pose:
    """Return a pose from which the heat source is visible, drawn uniformly from candidates on a sphere.

    **Raises:** `ValueError` if there is no such candidate.
    """
    poses = SphereCandidates(num_candidates, radius).poses()
    scans = scan(scene.surface, Camera(), poses)
    is_near = jnp.linalg.norm(scans.points - scene.source, axis=-1) < 0.05
    (indices,) = np.nonzero(jnp.any(is_near & scans.mask, axis=-1))
    require(len(indices) > 0, f"none of {num_candidates} candidates sees the heat source: ask for more of them")
    return poses[int(jax.random.choice(key, indices))]


# Each function below returns the primitives of an object, and the heat source's position on the first primitive, in the
# frame of this primitive and in units of its half sizes.


def _on_top(rng):
    return rng.uniform(-0.7, 0.7), 1.0, rng.uniform(-0.7, 0.7)


def _desk(rng):
    """Build a desk with four legs, a back panel and a drawer. It is heated on its top."""
    half_depth, half_width, height = rng.uniform(0.5, 0.65), rng.uniform(0.95, 1.2), rng.uniform(1.0, 1.3)
    thick, leg = rng.uniform(0.05, 0.08), rng.uniform(0.05, 0.08)
    parts = [box((0, height, 0), (half_depth, thick, half_width))]
    x, z = half_depth - leg - 0.02, half_width - leg - 0.02
    parts += [bar((a, 0, b), (a, height, b), leg, leg) for a in (-x, x) for b in (-z, z)]
    low = rng.uniform(0.15, 0.4) * height
    parts.append(box((-x, 0.5 * (low + height), 0), (0.04, 0.5 * (height - low), z)))
    half = (0.6 * half_depth, rng.uniform(0.15, 0.25), 0.3)
    parts.append(box((0.1, height - thick - half[1] + 0.02, z - 0.4), half))
    return parts, _on_top(rng)


def _chair(rng):
    """Build a chair with rails between its four legs and an open back. It is heated on its seat."""
    half_depth, half_width, height = rng.uniform(0.5, 0.6), rng.uniform(0.5, 0.6), rng.uniform(1.0, 1.2)
    thick, leg, rise = rng.uniform(0.05, 0.08), rng.uniform(0.05, 0.07), rng.uniform(0.8, 1.1)
    parts = [box((0, height, 0), (half_depth, thick, half_width), 0.03)]
    x, z = half_depth - leg, half_width - leg
    parts += [bar((a, 0, b), (a, height, b), leg, leg) for a in (-x, x) for b in (-z, z)]
    for a in (-x, x):
        y = rng.uniform(0.25, 0.45) * height
        parts.append(rod((a, y, -z), (a, y, z), 0.04))
    for b in (-z, z):
        y = rng.uniform(0.2, 0.5) * height
        parts.append(rod((-x, y, b), (x, y, b), 0.04))
    parts += [bar((-x, height, b), (-x - 0.12, height + rise, b), 0.05, 0.05) for b in (-z, z)]
    parts += [box((-x - 0.12 * part, height + rise * part, 0), (0.04, 0.1, z)) for part in (0.45, 0.85)]
    return parts, _on_top(rng)


def _mug(rng):
    """Build a hollow mug with a handle. It is heated from below."""
    radius, half_height, wall = rng.uniform(0.65, 0.8), rng.uniform(0.75, 0.95), rng.uniform(0.045, 0.06)
    parts = [
        rod((0, -half_height, 0), (0, -half_height + 0.12, 0), radius - wall),
        ring((0, 0, 0), (0, 1, 0), radius - wall, wall, half_height, 0.03),
    ]
    reach, top = rng.uniform(0.45, 0.6), rng.uniform(0.45, 0.65) * half_height
    angle = np.linspace(0.5 * np.pi, -0.5 * np.pi, 6)
    handle = np.stack([radius - wall + reach * np.cos(angle), top * np.sin(angle), np.zeros(6)], axis=-1)
    parts += path(handle, rng.uniform(0.07, 0.1))
    return parts, (rng.uniform(-0.5, 0.5), -1.0, rng.uniform(-0.5, 0.5))


def _fins(rng):
    """Build a plate with a row of upright fins. It is heated from below."""
    count, half_depth, half_width = int(rng.integers(6, 10)), rng.uniform(0.6, 0.9), rng.uniform(1.0, 1.2)
    rise, thick = rng.uniform(0.6, 1.0), rng.uniform(0.06, 0.1)
    parts = [box((0, 0, 0), (half_depth, thick, half_width))]
    for z in np.linspace(-half_width + 0.06, half_width - 0.06, count):
        height = rise * rng.uniform(0.7, 1.0)
        parts.append(box((0, 0.5 * height, z), (half_depth - 0.02, 0.5 * height, 0.035)))
    return parts, (rng.uniform(-0.7, 0.7), -1.0, rng.uniform(-0.7, 0.7))


_BUILDERS = {"desk": _desk, "chair": _chair, "mug": _mug, "fins": _fins}
HEAT_OBJECTS = tuple(_BUILDERS)
