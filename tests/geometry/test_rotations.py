"""Rotations: rotation vectors against SciPy, the 6-D map against Gram-Schmidt in float64, and the least rotation by its
angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxnbv.geometry.rotations import (
    rotation_about,
    rotation_between,
    rotation_from_6d,
    rotation_from_vector,
    rotation_to_6d,
    safe_norm,
)

RNG = np.random.default_rng(0)
FROM_6D, BETWEEN = jax.jit(rotation_from_6d), jax.jit(rotation_between)
FROM_6D_JACOBIAN = jax.jit(jax.jacfwd(rotation_from_6d)), jax.jit(jax.jacrev(rotation_from_6d))
ABOUT_SLOPE = jax.jit(jax.jacfwd(rotation_about, argnums=1))
VECTOR_JACOBIAN = jax.jit(jax.jacfwd(rotation_from_vector)), jax.jit(jax.jacrev(rotation_from_vector))
BETWEEN_JACOBIAN = jax.jit(jax.jacfwd(rotation_between, argnums=(0, 1))), jax.jit(jax.jacrev(rotation_between, (0, 1)))

component = st.floats(-1.0, 1.0, width=32)
vector = st.tuples(component, component, component)
scale = st.sampled_from([1e-12, 1e-6, 1.0, 1e6, 1e12])
# Share of the first vector in the second, and of another vector: parallel, nearly parallel, or neither.
mixture = st.sampled_from([(0.0, 1.0), (1.0, 0.0), (-1.0, 0.0), (1.0, 1e-8), (1.0, 1e-7), (-1.0, 1e-6), (1.0, 1e-4)])


def units(count):
    v = RNG.normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def error_of_rotations(rotations):
    """Largest entry of |R^T R - 1|, and the least determinant, in float64."""
    r = np.asarray(rotations, np.float64).reshape(-1, 3, 3)
    return np.abs(np.swapaxes(r, 1, 2) @ r - np.eye(3)).max(), np.linalg.det(r).min()


def assert_rotations(rotations, tolerance=1e-5):
    error, determinant = error_of_rotations(rotations)
    assert error < tolerance
    assert determinant > 1 - 3 * tolerance


def gram_schmidt(columns):
    a, b = np.split(np.asarray(columns, np.float64), 2, axis=-1)
    first = a / np.linalg.norm(a, axis=-1, keepdims=True)
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    across = np.cross(first, b)
    third = across / np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=-1)


@pytest.mark.parametrize("angle", [-4.0, 0.0, 1e-9, 1e-5, 0.3, np.pi])
def test_turns_are_those_of_scipy_with_their_derivatives(x64, angle):
    axis = 3.0 * units(1)[0]
    vector = angle * axis / 3.0
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_about(jnp.asarray(axis), jnp.asarray(angle)), expected, atol=1e-12)
    np.testing.assert_allclose(rotation_from_vector(jnp.asarray(vector)), expected, atol=1e-12)
    h = 1e-5
    about = [Rotation.from_rotvec((angle + s) * axis / 3.0).as_matrix() for s in (h, -h)]
    slope = ABOUT_SLOPE(jnp.asarray(axis), jnp.asarray(angle))
    np.testing.assert_allclose(slope, (about[0] - about[1]) / (2 * h), atol=1e-8)
    along = [[Rotation.from_rotvec(vector + s * e).as_matrix() for s in (h, -h)] for e in np.eye(3)]
    central = np.stack([(up - down) / (2 * h) for up, down in along], axis=-1)
    for jacobian in VECTOR_JACOBIAN:
        np.testing.assert_allclose(jacobian(jnp.asarray(vector)), central, atol=1e-5)


def test_at_zero_a_turn_has_the_cross_product_as_its_derivative():
    """In float32, without 0 / 0: d R u = d w x u. A length has no slope at zero."""
    slope = VECTOR_JACOBIAN[1](jnp.zeros(3))
    expected = np.stack([np.cross(e, np.eye(3)).T for e in np.eye(3)], axis=-1)
    np.testing.assert_array_equal(slope, expected)
    np.testing.assert_array_equal(jax.grad(lambda v: safe_norm(*v))(jnp.zeros(3)), np.zeros(3))
    np.testing.assert_allclose(jax.grad(lambda v: safe_norm(*v))(jnp.asarray([3.0, 0.0, 4.0])), [0.6, 0.0, 0.8])


def test_rotations_come_back():
    rotations = Rotation.random(2000, random_state=1).as_matrix()
    columns = rotation_to_6d(rotations.astype(np.float32))
    np.testing.assert_array_equal(columns, np.swapaxes(rotations, 1, 2)[:, :2].reshape(-1, 6).astype(np.float32))
    np.testing.assert_allclose(FROM_6D(columns), rotations, atol=5e-7)


def test_random_columns_against_gram_schmidt_in_double_precision():
    columns = RNG.normal(size=(5000, 6)).astype(np.float32)
    a, b = np.split(columns.astype(np.float64), 2, axis=-1)
    sine = np.linalg.norm(np.cross(a, b), axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    got = np.asarray(FROM_6D(columns))
    # Rounding of two unit vectors turns the orthogonal remainder of the second by itself over the sine between them.
    assert (np.abs(got - gram_schmidt(columns)).max(axis=(1, 2)) * sine).max() < 1e-6
    assert_rotations(got, 2e-6)
    # If the vectors are parallel up to rounding, the remainder is noise.
    for parallel in (a, -3 * a, a * (1 + 5e-7 * RNG.normal(size=a.shape))):
        assert_rotations(FROM_6D(np.concatenate([a, parallel], axis=1).astype(np.float32)))


@settings(max_examples=150)
@given(vector, vector, scale, scale, mixture)
@example((1.0, 1.0, 0.0), (0.0, 0.0, 0.0), 1.0, 1.0, (1.0, 0.0))
@example((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0, 1.0, (0.0, 1.0))
@example((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1.0, 1.0, (0.0, 1.0))
@example((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 1.0, 1.0, (0.0, 1.0))
def test_every_pair_of_vectors_gives_a_rotation(a, b, first_scale, second_scale, mixture):
    a, b = np.array(a), mixture[0] * np.array(a) + mixture[1] * np.array(b)
    columns = np.concatenate([first_scale * a, second_scale * b]).astype(np.float32)
    assert_rotations(FROM_6D(columns))
    forward, reverse = (np.asarray(jacobian(columns)) for jacobian in FROM_6D_JACOBIAN)
    assert np.isfinite(forward).all()
    assert np.isfinite(reverse).all()


def test_derivatives_of_the_map_against_central_differences(x64):
    columns, step = RNG.normal(size=(200, 6)), RNG.normal(size=(200, 6))
    sine = np.linalg.norm(np.cross(columns[:, :3], columns[:, 3:]), axis=1)
    columns = columns[(sine > 0.3) & (np.linalg.norm(columns[:, :3], axis=1) > 0.3)]
    step = step[: len(columns)]
    _, slope = jax.jvp(rotation_from_6d, (jnp.asarray(columns),), (jnp.asarray(step),))
    central = (rotation_from_6d(columns + 1e-5 * step) - rotation_from_6d(columns - 1e-5 * step)) / 2e-5
    assert len(columns) > 100
    np.testing.assert_allclose(slope, central, rtol=1e-6, atol=1e-6)


def test_least_rotation_takes_start_to_end_about_an_axis_orthogonal_to_both(x64):
    start, end = units(1000), units(1000)
    rotation = np.asarray(rotation_between(start, end))
    assert_rotations(rotation, 1e-13)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", rotation, start), end, atol=1e-13)
    turned = Rotation.from_matrix(rotation).as_rotvec()
    cosine = np.sum(start * end, axis=1)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.arccos(cosine), atol=1e-6)
    np.testing.assert_allclose(np.sum(turned * start, axis=1), 0.0, atol=1e-10)
    np.testing.assert_allclose(np.sum(turned * end, axis=1), 0.0, atol=1e-10)


def test_equal_vectors_are_not_turned():
    start = jnp.asarray(units(500), jnp.float32)
    np.testing.assert_allclose(BETWEEN(start, start), np.tile(np.eye(3), (500, 1, 1)), atol=5e-7)
    # The derivative has no singularity there: d R = [start x d end]_x.
    jacobian = np.asarray(BETWEEN_JACOBIAN[0](start[0], start[0])[1])
    move = np.cross(start[0], np.eye(3)[1])
    move /= np.linalg.norm(move)
    axis = np.cross(start[0], move)
    np.testing.assert_allclose(jacobian @ move, np.cross(axis, np.eye(3)).T, atol=2e-6)


def test_opposite_vectors_are_turned_by_half_a_turn_with_finite_derivatives():
    """Opposite exactly or up to rounding. Their sum is noise in any direction."""
    start = np.concatenate([units(2000), np.eye(3), -np.eye(3)]).astype(np.float32)
    for end in (-start, -start * np.float32(1 + 2e-7), -start + 1e-7 * RNG.normal(size=start.shape)):
        end = end.astype(np.float32)
        rotation = np.asarray(BETWEEN(start, end))
        assert_rotations(rotation)
        np.testing.assert_allclose(np.einsum("nij,nj->ni", rotation, start), end, atol=1e-5)
        for jacobian in BETWEEN_JACOBIAN:
            for side in jacobian(jnp.asarray(start[0]), jnp.asarray(end[0])):
                assert np.isfinite(side).all()


@pytest.mark.parametrize("angle", [1e-6, 1e-5, 1e-4, 1e-2])
def test_nearly_opposite_vectors(angle):
    start = units(2000)
    across = np.cross(start, units(2000))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    end = -np.cos(angle) * start + np.sin(angle) * across
    rotation = np.asarray(BETWEEN(start.astype(np.float32), end.astype(np.float32)))
    assert_rotations(rotation)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", rotation, start), end, atol=1e-5)
