"""Placements of known shapes, and the initial rotations of their search."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid
from jaxnbv.surfaces import Placement


def placement(seed=0):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    return Placement(*(jnp.asarray(x, jnp.float32) for x in (rotation, rng.normal(size=3), rng.uniform(0.5, 2, 3))))


def test_points_of_the_shape_are_where_the_formula_says():
    placed, u = placement(), np.random.default_rng(1).normal(size=(20, 3))
    x = np.asarray(placed.rotation) @ (np.asarray(placed.scale) * u)[:, :, None]
    np.testing.assert_allclose(placed.to_shape(jnp.asarray(x[:, :, 0] + np.asarray(placed.shift))), u, atol=2e-6)


def test_a_placed_solid_of_one_scale_has_exact_distances():
    """Against the same solid, scaled, rotated and moved as a solid."""
    rotation = Rotation.from_rotvec([0.3, -0.5, 0.2])
    placed = Placement(jnp.asarray(rotation.as_matrix(), jnp.float32), jnp.array([0.1, 0.2, -0.3]), jnp.full(3, 0.7))
    solid = Cuboid([0.5, 0.3, 0.2])
    angle = float(np.linalg.norm(rotation.as_rotvec()))
    moved = solid.scale(0.7).rotate(rotation.as_rotvec(), angle).translate([0.1, 0.2, -0.3])
    x = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (50, 3)), jnp.float32)
    np.testing.assert_allclose(placed.distance(solid, x), moved(x), atol=2e-6)


def test_a_step_turns_shifts_and_scales():
    placed, step = placement(), np.array([0.4, -0.2, 0.7, 0.1, 0.2, 0.3, 0.05, -0.1, 0.2])
    moved = placed.moved(jnp.asarray(step, jnp.float32))
    turned = Rotation.from_rotvec(step[:3]).as_matrix() @ np.asarray(placed.rotation)
    np.testing.assert_allclose(moved.rotation, turned, atol=2e-6)
    np.testing.assert_allclose(moved.shift, np.asarray(placed.shift) + step[3:6], atol=1e-6)
    np.testing.assert_allclose(moved.scale, np.asarray(placed.scale) * np.exp(step[6:]), rtol=1e-6)


def test_a_step_has_derivatives_where_nothing_is_turned():
    jacobian = jax.jacobian(lambda step: placement().moved(step).rotation)(jnp.zeros(9))
    cross = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(jacobian[..., 0], cross @ np.asarray(placement().rotation), atol=1e-6)
    np.testing.assert_allclose(jacobian[..., 3:], 0.0, atol=1e-7)


def test_free_rotations_leave_no_gap():
    """The spiral has a rotation within 15 degrees of any other. The same number of random ones would leave gaps."""
    rotations = nbv.surfaces.FreeRotation().rotations(4096)
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.broadcast_to(np.eye(3), (4096, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-12)
    targets = Rotation.random(200, random_state=0).as_matrix()
    trace = np.einsum("aij,bij->ab", targets, rotations)
    nearest = np.degrees(np.arccos(np.clip(0.5 * (trace.max(axis=1) - 1.0), -1, 1)))
    assert nearest.max() < 15.0


def test_upright_rotations_turn_about_the_vertical_within_their_range():
    rotations = nbv.surfaces.Upright((0.0, 0.0, 2.0), within=0.5).rotations(1000)
    np.testing.assert_allclose(rotations[:, :, 2], np.broadcast_to([0, 0, 1], (len(rotations), 3)), atol=1e-12)
    angles = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
    assert abs(angles).max() < 0.5
    assert np.diff(np.sort(angles)).max() < math.radians(2.1)
    assert len(rotations) <= 30


@pytest.mark.parametrize(
    ("poses", "count"),
    [
        (nbv.surfaces.FreeRotation(), 7),
        (nbv.surfaces.Upright(), 5),
        (nbv.surfaces.AsGiven(), 4),
        (nbv.surfaces.AsGiven(scale=(1.0, 1.0)), 3),
        (nbv.surfaces.Upright(by_axis=True), 7),
    ],
)
def test_steps_are_independent_and_of_unit_length(poses, count):
    steps = poses.step_basis
    assert steps.shape == (9, count)
    np.testing.assert_allclose(steps.T @ steps, np.eye(count), atol=1e-12)
