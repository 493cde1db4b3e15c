"""Signed distances against dense samplings of their surfaces, and set operations against membership."""

import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Capsule, Cone, Cuboid, Cylinder, SmoothUnion, Sphere, Torus, least_of_last

RNG = np.random.default_rng(0)

values = eqx.filter_jit(lambda sdf, x: sdf(x))
gradients = eqx.filter_jit(lambda sdf, x: jax.vmap(jax.grad(sdf))(x))


def revolve(profile):
    """A dense sampling of the surface of revolution of the polyline `profile` (n, 2), with columns radius and y."""
    ends = itertools.pairwise(profile)
    line = np.concatenate([np.linspace(a, b, math.ceil(np.linalg.norm(b - a) / 0.006) + 1) for a, b in ends])
    angle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    r, y = np.repeat(line, 600, axis=0).T
    angle = np.tile(angle, len(line))
    return np.stack([r * np.cos(angle), y, r * np.sin(angle)], axis=-1)


def arc(cx, cy, r, start, stop):
    t = np.linspace(start, stop, math.ceil(r * (stop - start) / 0.005) + 1)
    return np.stack([cx + r * np.cos(t), cy + r * np.sin(t)], axis=-1)


def box_surface(half):
    u = np.linspace(-1, 1, 200)
    a, b = (c.ravel() for c in np.meshgrid(u, u))
    faces = [np.insert(np.stack([a, b], -1), axis, side, axis=1) for axis in range(3) for side in (-1, 1)]
    return np.concatenate(faces) * half


def turned(points, axis, angle):
    axis = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.cross(axis, points)
    along = (points @ axis)[:, None] * axis
    return along + np.cos(angle) * (points - along) + np.sin(angle) * cross


CAPSULE_PROFILE = np.concatenate([arc(0, -0.5, 0.3, -np.pi / 2, 0), arc(0, 0.5, 0.3, 0, np.pi / 2)])
BALL = 0.8 * np.asarray(nbv.geometry.fibonacci_sphere(200_000))
EXACT = {
    "sphere": (Sphere(0.8), BALL),
    "box": (Cuboid([0.7, 0.5, 0.9]), box_surface([0.7, 0.5, 0.9])),
    "cylinder": (Cylinder(0.6, 0.8), revolve(np.array([[0, -0.8], [0.6, -0.8], [0.6, 0.8], [0, 0.8]]))),
    "cone": (Cone(0.9, 0.3, 0.6), revolve(np.array([[0, -0.6], [0.9, -0.6], [0.3, 0.6], [0, 0.6]]))),
    "flat cone": (Cone(0.1, 1.0, 0.1), revolve(np.array([[0, -0.1], [0.1, -0.1], [1.0, 0.1], [0, 0.1]]))),
    "pointed cone": (Cone(0.8, 0.0, 0.5), revolve(np.array([[0, -0.5], [0.8, -0.5], [0, 0.5]]))),
    "torus": (Torus(0.7, 0.25), revolve(arc(0.7, 0, 0.25, 0, 2 * np.pi))),
    "capsule": (Capsule([0, -0.5, 0], [0, 0.5, 0], 0.3), revolve(CAPSULE_PROFILE)),
    "capsule without a length": (Capsule([0, 0, 0], [0, 0, 0], 0.8), BALL),
    "moved": (
        Capsule([0, -0.5, 0], [0, 0.5, 0], 0.3).rotate([1, 2, 3], 0.7).scale(0.5).translate([0.2, -0.1, 0.3]),
        0.5 * turned(revolve(CAPSULE_PROFILE), [1, 2, 3], 0.7) + [0.2, -0.1, 0.3],
    ),
}
MUG = (Cylinder(0.8, 0.8) - Cylinder(0.7, 0.8).translate([0, 0.1, 0])) | Torus(0.4, 0.1).rotate(
    [1, 0, 0], np.pi / 2
).translate([0.8, 0, 0])
BOUNDS = {
    "union": Sphere(0.6).translate([0.3, 0, 0]) | Cuboid([0.5, 0.4, 0.3]),
    "smooth union": SmoothUnion(Sphere(0.6).translate([0.4, 0, 0]), Cylinder(0.3, 0.9), 0.3),
    "intersection": Sphere(0.8) & Cuboid([0.5, 0.6, 0.7]),
    "difference": Cuboid([0.8, 0.8, 0.8]) - Sphere(0.9),
    "mug": MUG.scale(0.9),
}


@pytest.mark.parametrize("name", EXACT)
def test_exact_distance_equals_that_to_a_dense_sampling_and_is_negative_inside_only(name):
    sdf, surface = EXACT[name]
    x = RNG.uniform(-1.6, 1.6, (3000, 3))
    nearest, _ = cKDTree(surface).query(x)
    value = np.asarray(values(sdf, x))
    far = nearest > 0.05
    # A sampling of spacing s overestimates a distance d by at most s^2 / (2 d). Here s < 0.012.
    np.testing.assert_allclose(np.abs(value[far]), nearest[far], atol=2e-3)
    assert (np.abs(value) <= nearest + 2e-5).all()
    # The distance is negative inside only.
    assert np.abs(np.asarray(values(sdf, surface))).max() < 2e-3
    outside = surface.mean(axis=0) + 4.0 * np.asarray(nbv.geometry.fibonacci_sphere(200))
    assert (np.asarray(values(sdf, outside)) > 0).all()
    gradient = np.asarray(gradients(sdf, jnp.asarray(surface[::37])))
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1) < 1e-3
    inward = surface[::37][smooth] - 0.02 * gradient[smooth]
    # Near a sharp edge a sample may move along a face, or outwards.
    assert (np.asarray(values(sdf, inward)) < -0.01).mean() > 0.8


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds_never_overestimate(name):
    """This follows from slopes of at most one between random points, near and far, and a change of sign at the
    surface."""
    sdf = BOUNDS[name]
    x = RNG.uniform(-1.6, 1.6, (20_000, 3))
    y = x + RNG.normal(size=x.shape) * 10.0 ** RNG.uniform(-2, 0.3, (len(x), 1))
    change = np.abs(np.asarray(values(sdf, x)) - np.asarray(values(sdf, y)))
    assert (change <= np.linalg.norm(x - y, axis=1) + 1e-5).all()


def test_a_rounded_box_is_all_that_is_near_to_a_smaller_one():
    x = RNG.uniform(-1.6, 1.6, (3000, 3))
    smaller = np.asarray(values(Cuboid([0.5, 0.3, 0.7]), x))
    np.testing.assert_allclose(values(Cuboid([0.7, 0.5, 0.9], 0.2), x), smaller - 0.2, atol=1e-6)


def test_set_operations_agree_with_membership():
    a, b = Sphere(0.7).translate([0.3, 0, 0]), Cuboid([0.6, 0.5, 0.4])
    x = RNG.uniform(-1.2, 1.2, (20_000, 3))
    in_a = np.linalg.norm(x - [0.3, 0, 0], axis=1) < 0.7
    in_b = (np.abs(x) < [0.6, 0.5, 0.4]).all(axis=1)
    for sdf, expected in ((a | b, in_a | in_b), (a & b, in_a & in_b), (a - b, in_a & ~in_b)):
        value = np.asarray(values(sdf, x))
        decided = np.abs(value) > 1e-5
        assert ((value < 0) == expected)[decided].all()
    union = np.asarray((a | b)(x))
    smooth = np.asarray(SmoothUnion(a, b, 0.2)(x))
    assert (smooth <= union + 1e-6).all()
    assert (smooth >= union - 0.05 - 1e-6).all()


def test_the_least_of_equal_values_has_the_derivative_of_the_first():
    values = jnp.array([[0.3, -0.2, -0.2, jnp.inf], [0.0, 0.5, 0.0, 0.0]])
    assert jnp.array_equal(least_of_last(values), values.min(axis=-1))
    slopes = jax.vmap(jax.grad(least_of_last))(values)
    assert jnp.array_equal(slopes, jnp.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]))
