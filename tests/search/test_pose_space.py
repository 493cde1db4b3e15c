"""Retractions: zero parameters change nothing, spheres and constraints hold for any parameters, and derivatives agree
with differences.

Rounding is tested at its worst: starts that look straight away from the origin, and steps to its far side.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.geometry.rotations import rotation_to_6d

RNG = np.random.default_rng(0)
LOOK_AT = jax.jit(nbv.look_at)
SPHERE, FREE, CONSTRAINED = nbv.search.SpherePoses(), nbv.search.FreePoses(), nbv.search.ConstrainedPoses(2.0, 3.0)
SPACES = {"sphere": SPHERE, "free": FREE, "constrained": CONSTRAINED}
RETRACT = {name: jax.jit(space.retract) for name, space in SPACES.items()}
RETRACT_MANY = {name: jax.jit(jax.vmap(space.retract)) for name, space in SPACES.items()}
JACOBIAN = {name: jax.jit(jax.jacfwd(space.retract, argnums=1)) for name, space in SPACES.items()}
FLAT = jax.jit(lambda start, parameters: flat(SPHERE.retract(start, parameters)))
# The same size for all batches, so that they share compiled programs.
MANY = 3000
FREEDOMS = {"sphere": 2, "free": 6, "constrained": 6}


def real(values):
    return jnp.asarray(values, jnp.result_type(float))


def units(count):
    v = RNG.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def starts_inside(count, radius=None):
    """Poses on the sphere of 2.5 that look at its centre, or without a radius poses in the shell with the origin in
    view."""
    at_centre = LOOK_AT(real((radius or RNG.uniform(2.1, 2.9, (count, 1))) * units(count)))
    turn = 0.0 if radius else RNG.uniform(-0.1, 0.1, (count, 3))
    turn = Rotation.from_rotvec(np.broadcast_to(turn, (count, 3)) * [1, 1, 10]).as_matrix()
    return nbv.Pose(at_centre.rotation @ real(turn), at_centre.position)


def starts_of(name, count):
    return starts_inside(count, None if name == "constrained" else 2.5)


def flat(pose):
    return jnp.concatenate([pose.rotation.reshape(*pose.position.shape[:-1], 9), pose.position], axis=-1)


def jacobian(name, start, parameters):
    """Derivative of the nine entries of the rotation and of the position in the parameters."""
    columns = JACOBIAN[name](start, real(parameters))
    return np.concatenate([columns.rotation.reshape(9, -1), columns.position])


def assert_rotation(rotation):
    rotation = np.asarray(rotation, np.float64)
    unity = np.swapaxes(rotation, -1, -2) @ rotation
    np.testing.assert_allclose(unity, np.broadcast_to(np.eye(3), unity.shape), atol=1e-5)
    assert (np.linalg.det(rotation) > 0).all()


def angle_to_origin(pose):
    """Angle between the optical axis and the direction to the origin, from sine and cosine, so that small angles are
    exact."""
    to_origin, forward = -np.asarray(pose.position, np.float64), np.asarray(pose.forward, np.float64)
    sine = np.linalg.norm(np.cross(to_origin, forward), axis=-1)
    return np.arctan2(sine, np.sum(to_origin * forward, axis=-1))


def assert_obeys(pose, space=CONSTRAINED):
    assert_rotation(pose.rotation)
    distance = np.linalg.norm(np.asarray(pose.position, np.float64), axis=-1)
    assert distance.min() > space.nearest - 1e-4
    assert distance.max() < space.farthest + 1e-4
    assert angle_to_origin(pose).max() < space.off_axis + 1e-4


@pytest.mark.parametrize("name", SPACES)
def test_zeros_lead_to_the_start(name):
    start = starts_of(name, MANY)
    end = RETRACT_MANY[name](start, jnp.zeros((MANY, SPACES[name].num_parameters)))
    np.testing.assert_allclose(end.rotation, start.rotation, atol=3e-6)
    np.testing.assert_allclose(end.position, start.position, atol=3e-6)


@pytest.mark.parametrize("name", SPACES)
def test_derivatives_equal_central_differences(name, x64):
    start, (parameters, step) = starts_of(name, 100), RNG.normal(size=(2, 100, SPACES[name].num_parameters))
    parameters *= 0.3
    ahead, behind = (flat(RETRACT_MANY[name](start, parameters + h * step)) for h in (1e-5, -1e-5))
    slope = jax.jit(jax.vmap(jax.jacfwd(lambda *at: flat(SPACES[name].retract(*at)), argnums=1)))(start, parameters)
    slope = np.einsum("nij,nj->ni", slope, step)
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", SPACES)
def test_degrees_of_freedom(name, x64):
    """The rank of the derivative of rotation and position, at the start and away from it."""
    starts = starts_of(name, 10)
    for i in range(10):
        for size in (0.0, 0.3):
            parameters = jnp.asarray(size * RNG.normal(size=SPACES[name].num_parameters))
            values = np.linalg.svd(jacobian(name, starts[i], parameters), compute_uv=False)
            freedoms = FREEDOMS[name]
            assert values[freedoms - 1] > 0.02
            assert values[freedoms:].max(initial=0.0) < 1e-12


def test_sphere_reaches_every_direction_and_does_not_roll():
    start, wanted = starts_inside(MANY, 2.5), units(MANY)
    before = np.asarray(start.position, np.float64) / 2.5
    end = RETRACT_MANY["sphere"](start, real(wanted - before))
    np.testing.assert_allclose(end.position, 2.5 * wanted, atol=2e-6)
    # The least rotation: its axis is orthogonal to both directions.
    turn = np.asarray(end.rotation, np.float64) @ np.swapaxes(np.asarray(start.rotation, np.float64), 1, 2)
    axis = Rotation.from_matrix(turn).as_rotvec()
    assert np.abs(np.sum(axis * before, axis=1)).max() < 1e-4
    assert np.abs(np.sum(axis * wanted, axis=1)).max() < 1e-4


@pytest.mark.parametrize("name", ["sphere", "constrained"])
def test_steps_to_the_far_side(name):
    """Near the antipode the rotation is one of many. It must still be a rotation."""
    start = starts_inside(MANY, 2.5)
    before = np.asarray(start.position / 2.5)
    for miss in (0.0, 1e-7, 1e-5, 1e-3):
        parameters = np.zeros((MANY, SPACES[name].num_parameters))
        parameters[:, :3] = -2 * before + miss * RNG.normal(size=(MANY, 3))
        end = RETRACT_MANY[name](start, real(parameters))
        np.testing.assert_allclose(end.position, -start.position, atol=3e-6 + 20 * miss)
        assert_rotation(end.rotation)
        assert angle_to_origin(end).max() < 1e-4
        assert np.isfinite(jacobian(name, start[0], parameters[0])).all()


@pytest.mark.parametrize("offset", [0.0, 1e-6])
@pytest.mark.parametrize("pole", [-1.0, 1.0])
def test_nothing_happens_at_the_poles(pole, offset, x64):
    """The derivative of the rotation is the same as elsewhere: the camera turns by as much as it moves."""
    start = nbv.look_at(jnp.asarray([offset, pole * 2.5, 0.5 * offset]))
    move = np.cross(np.asarray(start.position) / 2.5, units(1)[0])
    slope = jacobian("sphere", start, np.zeros(3)) @ move
    central = (FLAT(start, jnp.asarray(1e-5 * move)) - FLAT(start, jnp.asarray(-1e-5 * move))) / 2e-5
    np.testing.assert_allclose(slope, central, atol=1e-8)
    # A rotation by the angle v has |dR| = sqrt(2) v in the Frobenius norm.
    speed = np.linalg.norm(move)
    np.testing.assert_allclose(np.linalg.norm(slope[:9]), math.sqrt(2) * speed, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(slope[9:]), 2.5 * speed, rtol=1e-5)


def test_free_poses_reach_any_pose():
    start, wanted = starts_inside(MANY, 2.5), Rotation.random(MANY, random_state=3).as_matrix().astype(np.float32)
    position = real(3 * RNG.normal(size=(MANY, 3)))
    turn = rotation_to_6d(wanted) - rotation_to_6d(start.rotation)
    end = RETRACT_MANY["free"](start, jnp.concatenate([turn, position - start.position], axis=1))
    np.testing.assert_allclose(end.rotation, wanted, atol=2e-6)
    np.testing.assert_allclose(end.position, position, atol=2e-6)


number = st.one_of(st.floats(-3.0, 3.0, width=32), st.sampled_from([-1e6, -1e3, 0.0, 1e-6, 1e3, 1e6]))
place = st.tuples(*[st.floats(-4.0, 4.0, width=32)] * 3)
quaternion = st.tuples(*[st.floats(-1.0, 1.0, width=32)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


@settings(max_examples=120)
@given(place, quaternion, st.tuples(*[number] * 8))
@example((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0,) * 8)
@example((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -2.0, 0.0, 0.0, 0.0, -1.0, 0.0))
@example((0.0, 0.0, 2.5), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, -1.0, 1e6, -1e6, 1e6, -1.0, 0.0))
@example((9.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (1e6,) * 8)
def test_every_start_and_all_parameters_obey(position, quaternion, parameters):
    start = nbv.Pose(real(Rotation.from_quat(quaternion).as_matrix()), real(position))
    assert_obeys(RETRACT["constrained"](start, real(parameters)))
    assert np.isfinite(jacobian("constrained", start, parameters)).all()


def test_starts_that_look_straight_away_are_turned_to_the_origin():
    """The origin is behind them up to rounding, so that the direction of the rotation is arbitrary."""
    at_centre = LOOK_AT(real(RNG.uniform(0.5, 4.0, (MANY, 1)) * units(MANY)))
    away = nbv.Pose(at_centre.rotation * real([1.0, -1.0, -1.0]), at_centre.position)
    for parameters in (np.zeros((MANY, 8)), RNG.normal(size=(MANY, 8))):
        assert_obeys(RETRACT_MANY["constrained"](away, real(parameters)))


def test_constrained_poses_fill_their_range():
    """Distances from end to end, and directions all over the cone, reach exactly the allowed range."""
    space = nbv.search.ConstrainedPoses(1.5, 4.0, math.radians(25.0))
    start = nbv.look_at((0.0, 0.0, 2.0))
    parameters = np.zeros((2, 8))
    parameters[:, 3], parameters[:, 4] = (-30.0, 30.0), (-30.0, 30.0)
    end = jax.jit(jax.vmap(space.retract, in_axes=(None, 0)))(start, real(parameters))
    np.testing.assert_allclose(np.linalg.norm(end.position, axis=1), [1.5, 4.0], atol=2e-3)
    np.testing.assert_allclose(angle_to_origin(end), math.radians(25.0), atol=1e-3)
    assert_obeys(end, space)


def test_roll_turns_the_image_about_the_axis():
    parameters = np.zeros(8)
    parameters[6:] = math.cos(0.7) - 1, math.sin(0.7)
    start = starts_inside(1)[0]
    end = RETRACT["constrained"](start, real(parameters))
    np.testing.assert_allclose(angle_to_origin(end), angle_to_origin(start), atol=1e-5)
    straight = nbv.look_at((0.0, 0.0, 2.5))
    turn = np.asarray(straight.rotation.T @ RETRACT["constrained"](straight, real(parameters)).rotation)
    np.testing.assert_allclose(Rotation.from_matrix(turn).as_rotvec(), [0.0, 0.0, 0.7], atol=1e-5)
