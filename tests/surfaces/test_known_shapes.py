"""Known shapes as the prior: registration, weights and samples."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, SignedDistance, Sphere
from jaxnbv.surfaces.known_shapes import kind_of, systematic_resampling
from jaxnbv.surfaces.registration import FitTargets, Prior, register

CAMERA = nbv.Camera(height=40, width=40, fov=1.0)
# The two models differ in numbers only, and share programs.
QUICK, RESIDUAL = (
    nbv.ScreenedSPSR(nbv.GeometricSPSR(lengthscales, (0.2, 0.25), truncation=8), (nbv.surfaces.OnSurface(),))
    for lengthscales in ((0.02, 0.06), (0.02, 0.025))
)
GRID = nbv.Grid(40)


class Boxes(SignedDistance):
    """Two boxes that meet.

    - `sides`: half the lengths of their sides.
    - `middle`: centre of the second. The first is centred.
    """

    sides: Float[Array, "2 3"]
    middle: Float[Array, " 3"]

    def __call__(self, x):
        return jnp.minimum(Cuboid(self.sides[0])(x), Cuboid(self.sides[1])(x - self.middle))


def corner(arm):
    """A solid without symmetry. The second box is `arm` long, on either side of its centre."""
    return Boxes(jnp.array([[0.9, 0.3, 0.4], [0.2, arm, 0.25]]), jnp.array([0.6, 0.5, 0.1]))


ARMS = (0.35, 0.5, 0.65, 0.8)
BANK = nbv.ShapeBank.of([corner(arm) for arm in ARMS], [f"arm {arm}" for arm in ARMS])


def filling(arm, rotation):
    """The rotated solid, as large as its box allows and centred by its corners; its scale and shift."""
    boxes = np.array([[0.0, 0.0, 0.0], [0.6, 0.5, 0.1]]), np.array([[0.9, 0.3, 0.4], [0.2, arm, 0.25]])
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    turned = (boxes[0][:, None] + signs * boxes[1][:, None]).reshape(-1, 3) @ rotation.as_matrix().T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = 2.5 / (high - low).max()
    shift = -0.5 * scale * (low + high)
    placed = corner(arm).rotate(rotation.as_rotvec(), float(np.linalg.norm(rotation.as_rotvec())))
    return nbv.SDFSurface(placed.scale(scale).translate(shift)), scale, shift


# Nearly the identity, but a rotation all the same.
UPRIGHT = Rotation.from_rotvec([0.0, 1e-6, 0.0])


def model(bank=BANK, **changed):
    """The same model in most tests, which then share compiled programs."""
    return nbv.surfaces.KnownShapes(bank, RESIDUAL, model_of_none=QUICK, num_starts=2048, **changed)


def observations_of(surface, positions, noise=0.005):
    planner = nbv.Planner(
        nbv.Coverage(), camera=CAMERA, sampler=nbv.SurfaceSampler(grid=GRID), capacity=512, max_views=4
    )
    observations = None
    for index, position in enumerate(positions):
        pose = nbv.look_at(position)
        scan = nbv.SensorNoise(noise, noise)(nbv.scan(surface, CAMERA, pose), jax.random.key(index))
        observations = planner.init(pose, scan) if observations is None else planner.observe(observations, pose, scan)
    return observations


AROUND = ((0.5, 1.0, 3.2), (2.8, 1.2, -1.2), (-2.5, -1.5, -1.5))


def fits_of(bank, observations):
    return register(bank, Prior(nbv.surfaces.FreeRotation(), nbv.Box()), FitTargets.of(observations), 2048)


def test_planted_poses_are_recovered_and_modes_of_a_shape_are_far_apart():
    """Each shape of the bank in a pose of its own, seen from three sides."""
    turned, moved, shapes = [], [], []
    for index, arm in enumerate(ARMS):
        rotation = Rotation.random(random_state=index)
        surface, _, shift = filling(arm, rotation)
        fits = fits_of(BANK, observations_of(surface, AROUND))
        turned.append((Rotation.from_matrix(fits.placement.rotation[0]) * rotation.inv()).magnitude())
        moved.append(np.linalg.norm(fits.placement.shift[0] - shift))
        shapes.append(int(fits.shape[0]))
        is_distinct = np.asarray(fits.is_distinct)
        rotations, names = np.asarray(fits.placement.rotation)[is_distinct], np.asarray(fits.shape)[is_distinct]
        trace = np.einsum("aij,bij->ab", rotations, rotations)
        near = (trace > 1.0 + 2.0 * np.cos(np.radians(15.0))) & (names[:, None] == names)
        np.testing.assert_array_equal(near, np.eye(len(names), dtype=bool))
        assert np.all(np.diff(fits.misfit) >= 0)
    assert np.degrees(np.median(turned)) < 3.0
    assert np.median(moved) < 0.02
    # The true shape fits best.
    assert shapes == [0, 1, 2, 3]


def test_a_symmetric_shape_stands_in_all_the_ways_that_look_alike():
    """A bar may be rotated by half a turn about each of its axes."""
    bars = [Boxes(jnp.array(2 * [[1.2, 0.3, height]]), jnp.zeros(3)) for height in (0.45, 0.55, 0.65, 0.75)]
    fits = fits_of(nbv.ShapeBank.of(bars), observations_of(nbv.SDFSurface(Cuboid([1.25, 0.31, 0.47])), AROUND))
    good = np.asarray(fits.is_distinct & (fits.misfit < 0.2) & (fits.shape == 0))
    diagonals = np.einsum("aii->ai", fits.placement.rotation)[good]
    expected = [[-1, -1, 1], [-1, 1, -1], [1, -1, -1], [1, 1, 1]]
    np.testing.assert_allclose(diagonals[np.lexsort(np.rint(diagonals).T[::-1])], expected, atol=0.01)


def test_shapes_are_fitted_to_empty_space_too():
    observations = observations_of(nbv.SDFSurface(Cuboid([0.5, 0.3, 0.4])), AROUND)
    targets = FitTargets.of(observations)
    assert bool(targets.is_empty.all())
    node = (np.asarray(targets.empty, np.float64) + GRID.half_extent) / GRID.spacing
    np.testing.assert_allclose(node, np.rint(node), atol=1e-4)
    assert np.asarray(observations.empty_nodes)[tuple(np.rint(node).astype(int).T)].all()
    nothing = dataclasses.replace(observations, empty_nodes=None, grid=None)
    assert not bool(FitTargets.of(nothing).is_empty.any())


def test_shapes_of_a_kind_differ_by_their_number():
    kinds = {"chair 3": "chair", "office chair 12": "office chair", "chair": "chair", "arm 0.5": "arm 0.5", " 7": " 7"}
    assert {name: kind_of(name) for name in kinds} == kinds


def test_without_a_fit_none_is_the_answer():
    observations = observations_of(nbv.SDFSurface(Sphere(1.2)), AROUND)
    posterior = model().condition(observations)
    assert posterior.hypotheses[0].name == "none of these"
    assert posterior.hypotheses[0].weight > 0.95
    surfaces = posterior.sample(jax.random.key(0), 4)
    plain = QUICK.condition(observations)
    x = jnp.asarray(np.random.default_rng(0).uniform(-1.2, 1.2, (64, 3)), jnp.float32)
    *_, unknown_key = jax.random.split(jax.random.key(0), 3)
    np.testing.assert_allclose(surfaces(x), plain.sample(unknown_key, 4)(x) - plain.level, atol=1e-6)


@pytest.mark.as_users
def test_without_shapes_the_model_is_the_unknown_one_to_the_bit():
    observations = observations_of(nbv.SDFSurface(Sphere(1.2)), AROUND[:1])
    empty = model(nbv.ShapeBank.of([])).condition(observations)
    assert eqx.tree_equal(empty, QUICK.condition(observations))


def test_samples_of_one_exact_shape_equal_it_to_the_noise():
    """Also on sides that no view has seen: points of the true surface lie within the noise of each sample's surface."""
    surface, _, _ = filling(0.65, UPRIGHT)
    truth = nbv.mesh_from_sdf(surface.sdf, nbv.Grid(100, 1.4))
    points = jnp.asarray(truth.frame.to_world(truth.sample_points(jax.random.key(1), 400)), jnp.float32)
    posterior = model().condition(observations_of(surface, AROUND[:2]))
    # Its weight is one, in the best of its registered placements.
    best = int(np.flatnonzero(np.asarray(posterior.fits.shape) == 2)[0])
    posterior = posterior.given(best)
    assert posterior.hypotheses[0].name == "arm 0.65"
    fields = posterior.sample(jax.random.key(0), 4)
    slope = jnp.linalg.norm(fields.gradient(points), axis=-1)
    away = np.abs(np.asarray(fields(points) / slope))
    # Scale and shift are estimated with a noise of 0.005. The residual's own deviation is of that order.
    assert np.median(away) < 0.015
    assert np.quantile(away, 0.9) < 0.05


def test_weights_are_tempered_fits():
    observations = observations_of(filling(0.5, UPRIGHT)[0], AROUND[:1])
    posterior = model(poses=nbv.surfaces.Upright(), inverse_temperature=7.0, misfit_of_none=0.4).condition(observations)
    fits = posterior.fits
    np.testing.assert_allclose(fits.placement.rotation[:, 1, 1], 1.0, atol=1e-5)
    energy = np.append(
        np.where(fits.is_distinct, np.exp(-7.0 * np.asarray(fits.misfit, np.float64)), 0.0), np.exp(-2.8)
    )
    np.testing.assert_allclose(posterior.weights, energy / energy.sum(), rtol=1e-4, atol=1e-7)
    listed = posterior.hypotheses
    assert sum(one.weight for one in listed) == pytest.approx(1.0, abs=1e-4)
    assert [one.weight for one in listed] == sorted((one.weight for one in listed), reverse=True)
    assert "none of these" in [one.name for one in listed]


@settings(max_examples=40)
@given(st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7).filter(lambda w: sum(w) > 0.1), st.integers(0, 10**6))
def test_systematic_resampling_draws_each_as_often_as_its_weight_says(weights, seed):
    weights = np.asarray(weights, np.float32)
    drawn = np.asarray(systematic_resampling(jax.random.key(seed), jnp.asarray(weights), 16))
    counts = np.bincount(drawn, minlength=7)
    expected = 16 * weights.astype(np.float64) / weights.astype(np.float64).sum()
    assert np.all(np.abs(counts - expected) < 1.0 + 1e-3)


@pytest.mark.slow
def test_the_same_observations_have_the_same_hypotheses_and_nothing_is_compiled_twice(compilations):
    surface, _, _ = filling(0.5, UPRIGHT)
    sampler = dataclasses.replace(nbv.SurfaceSampler(QUICK, GRID, 3).with_bank(BANK, nbv.surfaces.AsGiven()))
    sampler = dataclasses.replace(sampler, model=dataclasses.replace(sampler.model, residual=RESIDUAL, num_starts=64))
    first, second = observations_of(surface, AROUND[:1]), observations_of(surface, AROUND[:2])
    assert eqx.tree_equal(sampler.posterior(first).fits, sampler.posterior(first).fits)
    sampler.sample(first, jax.random.key(0))
    compilations.clear()
    sampler.sample(second, jax.random.key(1))
    assert not compilations
