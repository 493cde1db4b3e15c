"""The labelled solid against formulas in float64 NumPy and against the exact primitives of `sdf`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnbv.checks import InputError
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import look_at
from jaxnbv.scanning import SDFSurface, scan
from jaxnbv.scanning.sdf import Capsule, Cuboid, Cylinder, Sphere, Torus
from jaxnbv.studies.scenes.labelled import (
    CAPACITY,
    LabelledSolid,
    assemble,
    ball,
    bar,
    box,
    path,
    ring,
    rod,
    rotation_about,
)

RNG = np.random.default_rng(0)

FIELDS = ("centre", "rotation", "half_size", "rounding", "radius", "slant", "revolved", "labels")


evaluate = eqx.filter_jit(lambda solid, x: (solid.distances(x), solid(x), solid.part_labels(x)))
slopes_of = eqx.filter_jit(lambda solid, x: jax.vmap(jax.grad(solid))(x))


def points(count=4000, reach=1.6):
    """Always the same shape, so that one program serves all tests."""
    return jnp.asarray(RNG.uniform(-reach, reach, (count, 3)))


def random_solid(count=CAPACITY, size=0.4):
    """Alternating boxes and revolved rectangles, some of them steep, each with its own label."""
    primitives = []
    for label in range(count):
        centre, axis = RNG.uniform(-1, 1, (2, 3))
        half = RNG.uniform(0.05, size, 3)
        rounding = RNG.uniform() * half.min()
        if label % 2:
            radius = RNG.choice([0.0, RNG.uniform(0.2, 0.6)])
            slant = RNG.uniform(-1, 1) * half[0] / half[1]
            primitives.append(ring(label, centre, axis, radius, half[0], half[1], rounding, slant))
        else:
            primitives.append(box(label, centre, half, rounding, (axis, RNG.uniform(0, 3))))
    return assemble(primitives, RNG.uniform(0, 3))


def oracle(solid, x):
    """Distances to the primitives from the nearest point of an inflated core, infinite for unused slots."""
    centre, rotation, half, rounding, radius, slant, revolved, labels = (
        np.asarray(getattr(solid, name), np.float64) for name in FIELDS
    )
    distances = np.full((len(x), CAPACITY), np.inf)
    for k in np.flatnonzero(labels >= 0):
        own, core, stretch = (x - centre[k]) @ rotation[k], half[k] - rounding[k], 1.0
        if revolved[k]:
            out = np.hypot(own[:, 0], own[:, 2]) - radius[k] - slant[k] * own[:, 1]
            own, core = np.stack([out, own[:, 1]], axis=-1), core[:2]
            stretch = np.linalg.norm([[1.0, -slant[k]], [0.0, 1.0]], ord=2)
        outside = np.linalg.norm(own - np.clip(own, -core, core), axis=1)
        within = np.min(core - np.abs(own), axis=1)
        distances[:, k] = (np.where(outside > 0, outside, -within) - rounding[k]) / stretch
    return distances


def test_distances_are_those_of_the_formulas(x64):
    for count in (1, 7, CAPACITY):
        solid, x = random_solid(count), points()
        expected = oracle(solid, x)
        distances, least, label = evaluate(solid, x)
        np.testing.assert_allclose(distances, expected, atol=1e-12)
        np.testing.assert_allclose(least, expected.min(axis=1), atol=1e-12)
        np.testing.assert_array_equal(label, np.abs(expected).argmin(axis=1))
        assert (expected.min(axis=1) < 0).any()


# In units of the object, whose longest side determines the scale of `assemble`. All are centred.
CLOSED = {
    "ball": ([ball(3, (1, 2, 3), 0.8)], Sphere(0.8), 1.6),
    "box": ([box(3, (1, 2, 3), (0.7, 0.5, 0.9), 0.2)], Cuboid([0.7, 0.5, 0.9], 0.2), 1.8),
    "sharp box": ([box(3, (0, 0, 0), (0.7, 0.5, 0.9), 0.0)], Cuboid([0.7, 0.5, 0.9]), 1.8),
    "cylinder": ([rod(3, (1, -0.8, 0), (1, 0.8, 0), 0.6, rounding=0.0)], Cylinder(0.6, 0.8), 1.6),
    "torus": ([ring(3, (1, 0, 0), (0, 1, 0), 0.7, 0.25, 0.25, 0.25)], Torus(0.7, 0.25), 1.9),
    "capsule": (
        path(3, [(0.3, -0.5, 0), (0.7, 0.5, 0.4)], 0.3),
        Capsule([-0.2, -0.5, -0.2], [0.2, 0.5, 0.2], 0.3),
        1.6,
    ),
    "bar": ([bar(3, (0, 0, 0), (0, 1.8, 0), 0.5, 0.3, 0.1)], Cuboid([0.3, 0.9, 0.5], 0.1), 1.8),
    "turned": (
        [box(3, (0, 0, 0), (0.2, 0.4, 0.9), 0.1, ((0, 1, 0), np.pi / 2))],
        Cuboid([0.2, 0.4, 0.9], 0.1).rotate([0, 1, 0], np.pi / 2),
        1.8,
    ),
}


@pytest.mark.parametrize("name", CLOSED)
def test_special_cases_have_closed_forms(name, x64):
    primitives, expected, longest = CLOSED[name]
    scale = 2.5 / longest
    x = points()
    _, distance, label = evaluate(assemble(primitives), x)
    np.testing.assert_allclose(distance, scale * expected(x / scale), atol=1e-6)
    np.testing.assert_array_equal(label, 3)


def test_slopes_are_at_most_one_and_nearly_so(x64):
    steepest = []
    for _ in range(8):
        solid = random_solid(6)
        x = points()
        y = x + RNG.normal(size=x.shape) * 10.0 ** RNG.uniform(-3, 0.3, (len(x), 1))
        a, b = (np.asarray(evaluate(solid, ends)[0])[:, :6] for ends in (x, y))
        slopes = np.abs(a - b) / np.linalg.norm(x - y, axis=1, keepdims=True)
        steepest.append(slopes.max())
    assert 0.99 < max(steepest) <= 1 + 1e-9


def test_gradients_are_those_of_finite_differences(x64):
    solid, x, step = random_solid(12), points(), 1e-6
    ends = [[np.asarray(evaluate(solid, x + sign * o)[1]) for sign in (1, -1)] for o in step * np.eye(3)]
    expected = np.stack([(after - before) / (2 * step) for after, before in ends], axis=-1)
    x = x.at[:12].set(solid.centre[:12])
    gradient = np.asarray(slopes_of(solid, x))
    # Across a crease the difference mixes two faces.
    assert (np.abs(gradient - expected)[12:].max(axis=1) > 1e-6).mean() < 0.01
    assert np.isfinite(gradient).all()


def test_one_program_scans_any_solid(compilations):
    camera, pose = Camera(height=12, width=12), look_at([0.5, 0.6, 1.9])

    @eqx.filter_jit
    def look(solid):
        hits = scan(SDFSurface(solid), camera, pose)
        return hits, solid.part_labels(hits.points)

    solids = [random_solid(count, 0.6) for count in (3, 11, CAPACITY)]
    clouds = [look(solids[0])]
    compilations.clear()
    clouds += [look(solid) for solid in solids[1:]]
    assert not compilations
    for solid, (hits, label) in zip(solids, clouds, strict=True):
        mask = np.asarray(hits.mask)
        distances = np.abs(oracle(solid, np.asarray(hits.points, np.float64)[mask]))
        assert mask.sum() > 20
        assert distances.min(axis=1).max() < 1e-4
        assert (np.asarray(label)[mask] == distances.argmin(axis=1)).mean() > 0.97


def test_rotations_are_right_handed():
    np.testing.assert_allclose(rotation_about((0, 2, 0), np.pi / 2) @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    turned = assemble([ball(0, (1, 0, 0), 0.5), ball(1, (-1, 0, 0), 0.1)], np.pi / 2)
    assert turned.centre[0, 2] < turned.centre[1, 2]
    assert abs(float(turned.centre[0, 0])) < 1e-6


def test_bad_input_is_refused():
    with pytest.raises(InputError, match="has 25 primitives"):
        assemble([ball(0, (0, 0, 0), 1.0)] * 25)
    solid = random_solid(2)
    leaves = {name: getattr(solid, name) for name in FIELDS}
    with pytest.raises(InputError, match="must not be negative"):
        LabelledSolid(**{**leaves, "radius": jnp.full(CAPACITY, -2.0)})
